"""
The `starcal` tool.

Exit status: 0 the command succeeded, and a calibration passed the gate; 3 the gate refused the
calibration, whose products are written, or a bag cannot be calibrated; 2 bad input, one line on
stderr; 130 interrupted.
"""

# PYTHON_ARGCOMPLETE_OK: the shell's global completion looks for this word.
from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import dataclasses
import json
import os
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from starcal_ros.cli import mission
from starcal_ros.cli.arguments import (
    complain,
    EXIT_ACCEPTED,
    EXIT_BAD_INPUT,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    parser,
)
from starcal_ros.cli.terminal import print_verdict, progress_bar, with_progress
from starcal_ros.errors import OptionError, StarcalError, TooFewObservations

# NumPy, SciPy and OpenCV take a second to import: each command imports what it needs, so that
# --help answers at once.
if TYPE_CHECKING:
    from starcal_ros.pipeline.setup import Setup
    from starcal_ros.pipeline.topics import Topics
    from starcal_ros.records import Calibration, Ensemble

_MODULES_OF_EXTRAS = (
    'dask',
    'distributed',
    'jinja2',
    'markupsafe',
    'matplotlib',
    'pyarrow',
)  # setup.cfg
_DEMO_SAME_PX = 1e-6  # rounding that depends on the threads of BLAS
_DEMO_SIGMAS = 5.0  # exceeded by one random demo in 10^5; with the fixed seed by none


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns the exit status."""
    # Read when NumPy is loaded: on matrices of this size two threads of BLAS wait for each other.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    try:
        tool = parser()
        if '_ARGCOMPLETE' in os.environ:  # set by a shell that completes a command line
            import argcomplete

            argcomplete.autocomplete(tool)
        args = tool.parse_args(argv)
        if args.version:
            print(_software())
        elif args.command is None:
            tool.print_help()
        else:
            return _COMMANDS[args.command](args)
        return EXIT_ACCEPTED
    except StarcalError as error:
        return complain(str(error))
    except BrokenPipeError:
        # The reader of our output has ended (starcal ... | head).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BAD_INPUT
    except OSError as error:
        return complain(f'{error.filename or "input/output"}: {error.strerror or error}')
    except ModuleNotFoundError as error:
        extra = {'campaign': 'studies', 'trend': 'mission'}.get(args.command, 'report')
        return complain(_missing_extra(error, extra))
    except KeyboardInterrupt:
        complain('interrupted')
        return EXIT_INTERRUPTED


def _calibrate(args: argparse.Namespace) -> int:
    """Calibrate from bags in one process, as the two nodes do on the graph."""
    from starcal_ros.bag import reader
    from starcal_ros.cli import output
    from starcal_ros.pipeline.provenance import inputs_of
    from starcal_ros.pipeline.setup import read_setup

    setup = read_setup(args.params)
    if args.output.exists() and not args.output.is_dir():
        raise OptionError(f'{args.output}: not a folder')
    inputs = inputs_of((*reader.mcap_files(args.bags), args.params))
    calibration = _calibrate_into(args.output, args.bags, _asked(args), setup, inputs)
    report = _write_report(args.output)
    output.print_calibration(calibration, setup.prior)
    print(f'products written to {args.output}; {report}')
    return EXIT_ACCEPTED if calibration.accepted else EXIT_REFUSED


def _calibrate_into(
    folder: Path, bags: Sequence[Path], asked: Topics, setup: Setup, inputs: Mapping[str, str]
) -> Calibration:
    """Calibrate from bags and write the files that a report is made from."""
    from starcal_ros.pipeline import solve
    from starcal_ros.pipeline import topics as bag_topics
    from starcal_ros.products.folder import write_observations, write_products
    from starcal_ros.records import Ensemble
    from starcal_ros.report import thumbnails

    topics = bag_topics.choose_topics(bags, asked, setup)
    album = thumbnails.Album()
    records = bag_topics.read(bags, topics, setup, album.show)
    observations = list(with_progress(records, bag_topics.count(bags, topics), 'images'))
    ensemble = Ensemble()
    for record in observations:
        ensemble = solve.add_to_ensemble(ensemble, record, setup)
    _make_folder(folder)
    # After all reading: the bag may be the observations.mcap of an earlier run in this folder.
    write_observations(observations, folder, setup.frames.camera_frame)
    try:
        calibration, left = solve.solve_with_residuals(ensemble, setup, inputs=inputs)
    except TooFewObservations as error:
        words = f'{error}{_refused_words(ensemble)}'
        if topics.image and not ensemble.images:
            from starcal_ros.cli import diagnosis

            words = f'{words}. {diagnosis.in_a_sentence(bags, asked, setup)}'
        raise TooFewObservations(words.removesuffix('. ')) from error
    write_products(calibration, folder, left)
    thumbnails.write_thumbnails(album.thumbnails(), folder / thumbnails.THUMBNAILS_FOLDER)
    return calibration


def _asked(args: argparse.Namespace) -> Topics:
    from starcal_ros.pipeline.topics import Topics

    return Topics(
        image=args.image_topic,
        attitude=args.attitude_topic,
        velocity=args.velocity_topic,
        temperature=args.temperature_topic,
        observations=args.observations_topic,
    )


def _report(args: argparse.Namespace) -> int:
    """Write the report of a folder."""
    from starcal_ros.report import page

    print(f'report written to {page.write_report(args.folder)}')
    return EXIT_ACCEPTED


def _write_report(folder: Path) -> str:
    """Write the report of a folder; returns where it is, or why there is none."""
    try:
        from starcal_ros.report import page
    except ModuleNotFoundError as error:
        return f'no report: {_missing_extra(error, "report")}'
    return f'look at {page.write_report(folder)}'


def _missing_extra(error: ModuleNotFoundError, extra: str) -> str:
    """One line that names the extra to install; raises what is missing for another reason."""
    if error.name not in _MODULES_OF_EXTRAS:
        raise error
    return f"{error.name} is not installed: pip install 'starcal_ros[{extra}]'"


def _refused_words(ensemble: Ensemble) -> str:
    counted = ', '.join(f'{reason} {count}' for reason, count in ensemble.refused.items())
    return f' ({counted})' if counted else ''


def _inspect(args: argparse.Namespace) -> int:
    """List the contents of a bag and the images that a calibration would refuse."""
    from starcal_ros.bag import reader
    from starcal_ros.cli import output
    from starcal_ros.messages.types import COMPRESSED_TYPE, IMAGE_TYPE, OBSERVATIONS_TYPE
    from starcal_ros.pipeline import inspect
    from starcal_ros.pipeline.setup import read_setup

    setup = read_setup(args.params) if args.params else None
    kinds = (IMAGE_TYPE, COMPRESSED_TYPE, OBSERVATIONS_TYPE)
    total = max((t.count for t in reader.topics(args.bags) if t.type_name in kinds), default=0)
    with progress_bar(total, 'images') as advance:
        found = inspect.inspect(args.bags, _asked(args), setup, on_image=advance)
    if setup and found.images and not found.stars_per_image and found.chosen:
        from starcal_ros.cli import diagnosis

        why = diagnosis.in_a_sentence(args.bags, _asked(args), setup)
        found = dataclasses.replace(found, problems=(*found.problems, why)) if why else found
    if args.json:
        print(json.dumps(inspect.content(found), indent=1, allow_nan=False))
    else:
        output.print_inspection(found)
    return EXIT_REFUSED if found.problems else EXIT_ACCEPTED


def _diagnose(args: argparse.Namespace) -> int:
    """Say why the images of a bag match nothing."""
    from starcal_ros.cli import diagnosis
    from starcal_ros.pipeline.setup import read_setup

    found = diagnosis.of_bags(args.bags, _asked(args), read_setup(args.params))
    if args.json:
        print(json.dumps(diagnosis.content(found), indent=1, allow_nan=False))
    else:
        print(diagnosis.text(found))
    return EXIT_ACCEPTED if found.cause == 'none' else EXIT_REFUSED


def _compare(args: argparse.Namespace) -> int:
    """Compare two calibrations."""
    from starcal_ros.assessment import comparison
    from starcal_ros.cli import output
    from starcal_ros.products.calibration_json import read_calibration
    from starcal_ros.products.folder import calibration_file

    found = comparison.compare(*(read_calibration(calibration_file(p)) for p in (args.a, args.b)))
    if args.output:
        from starcal_ros.report import figures

        figures.write_comparison(found, args.output)
    if args.json:
        print(json.dumps(comparison.content(found), indent=1, allow_nan=False))
    else:
        output.print_comparison(found)
        if args.output:
            print(f'figure written to {args.output}')
    return EXIT_ACCEPTED


def _lookup(args: argparse.Namespace) -> int:
    """Write a table of lines of sight by pixel."""
    from starcal_ros.assessment.lookup import line_of_sight_table, pixels_every
    from starcal_ros.camera import pixel_grid
    from starcal_ros.products.calibration_json import read_calibration
    from starcal_ros.products.folder import calibration_file
    from starcal_ros.products.lookup_table import write_lookup_table

    calibration = read_calibration(calibration_file(args.calibration))
    camera = calibration.geometry.camera
    if args.step is not None:
        if not 0 < args.step <= max(camera.width, camera.height):
            raise OptionError(f'--step: {args.step:g} px is not within the detector')
        pixels = pixels_every(camera, args.step)
    else:
        if not 2 <= args.points <= 2000:
            raise OptionError(f'--points: {args.points} is not in the range 2 to 2000')
        pixels = pixel_grid(camera, args.points, args.points)
    table = line_of_sight_table(camera, calibration.joint_covariance, pixels)
    write_lookup_table(table, args.output)
    print(f'{len(pixels)} lines of sight written to {args.output}')
    return EXIT_ACCEPTED


def _play(args: argparse.Namespace) -> int:
    """Replace this process by the bag player."""
    from starcal_ros.bag import reader
    from starcal_ros.cli import demo

    reader.mcap_files([args.bag])
    if not 0 <= args.rate <= 1e6:
        raise OptionError(f'--rate: {args.rate} is not within 0 to 1e6')
    for remap in args.remap:
        if not all(remap.partition(':=')[::2]):
            raise OptionError(f'--remap: {remap!r} is not of the form A:=B')
    sys.stdout.flush()
    os.execv(sys.executable, demo.player_command(args.bag, args.rate, args.remap))


def _simulate(args: argparse.Namespace) -> int:
    """Render a named scenario."""
    from starcal_ros.options import nearest
    from starcal_ros.simulation import bag as simulated_bag
    from starcal_ros.simulation import scenario as synthetic

    if args.scenario not in synthetic.SCENARIOS:
        known = ', '.join(synthetic.SCENARIOS) + nearest(args.scenario, synthetic.SCENARIOS)
        raise OptionError(f'--scenario: {args.scenario!r} is not one of {known}')
    if args.seed < 0:
        raise OptionError(f'--seed: {args.seed} is negative')
    scenario = synthetic.scenario(args.scenario, args.seed)
    with progress_bar(scenario.image_count, 'images') as advance:
        made = simulated_bag.write_bag(scenario, args.output, on_image=lambda _: advance())
    print(f'bag {made.bag}, {scenario.image_count} images, seed {args.seed}')
    print(f'truth {made.truth}')
    print(f'calibrate with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return EXIT_ACCEPTED


def _demo(args: argparse.Namespace) -> int:
    """Calibrate the small bag with the real nodes and compare the result with the truth."""
    from starcal_ros.assessment import comparison
    from starcal_ros.cli import demo
    from starcal_ros.pipeline.setup import load_setup
    from starcal_ros.pipeline.topics import Topics
    from starcal_ros.products.folder import write_products
    from starcal_ros.report import page

    _make_folder(args.output)
    bag = demo.tiny_bag(args.output)
    print(f'bag {bag.bag}; log files and products in {args.output}')
    with progress_bar(bag.image_count, 'images') as advance:
        calibration, verdict = demo.run(bag, args.output, on_image=advance)
    print(verdict)
    if calibration is None:
        return EXIT_REFUSED
    beside_truth = demo.compare(calibration, bag.truth, bag.prior)
    print('\n'.join(beside_truth.lines))
    good = beside_truth.worst_sigmas <= _DEMO_SIGMAS
    print_verdict(
        good,
        f'largest error {beside_truth.worst_sigmas:.1f} sigma, '
        f'{"within" if good else "over"} the limit of {_DEMO_SIGMAS:g} sigma',
    )
    # The nodes publish no residuals: take those of the tool, whose calibration must be the same.
    setup = load_setup(bag.parameters)
    again = _calibrate_into(args.output, [bag.bag], Topics(), setup, {})
    write_products(calibration, args.output)
    apart_px = float(comparison.compare(calibration, again).before.length_px.max())
    same = apart_px <= _DEMO_SAME_PX
    print_verdict(
        same,
        'starcal calibrate gives the same calibration from the bag'
        if same
        else f'starcal calibrate gives another calibration from the bag: {apart_px:.2g} px apart',
    )
    print(f'open {page.write_report(args.output)}')
    good = good and same
    return EXIT_ACCEPTED if good else EXIT_REFUSED


def _campaign(args: argparse.Namespace) -> int:
    """Run a Monte Carlo study."""
    # Trials run in parallel, one thread each; results must not depend on the number of threads.
    os.environ.update(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1')
    import time

    from starcal_ros.options import nearest
    from starcal_ros.products.files import write_atomically
    from starcal_ros.studies import figures, monte_carlo, summary
    from starcal_ros.studies.workers import run_trials

    if args.study == 'paper':
        return _paper(args)
    if args.study not in monte_carlo.STUDIES:
        studies = (*monte_carlo.STUDIES, 'paper')
        known = ', '.join(studies) + nearest(args.study, studies)
        raise OptionError(f'STUDY: {args.study!r} is not one of {known}')
    what, default = monte_carlo.STUDIES[args.study]
    design = dataclasses.replace(
        default,
        trials=default.trials if args.trials is None else args.trials,
        seed=args.seed,
        images=tuple(args.images or default.images),
        stars=tuple(args.stars or default.stars),
        tracker_arcsec=tuple(args.tracker or default.tracker_arcsec),
        methods=tuple(args.methods or default.methods),
        assumed_arcsec=args.tracker_assumed,
    )
    monte_carlo.check(design)
    workers = _workers(args)
    _make_folder(args.output)
    start = time.monotonic()
    with progress_bar(design.trials, 'trials') as advance:
        rows = run_trials(design, workers, args.scheduler, advance)
    seconds = time.monotonic() - start
    found = summary.conclude(design, rows)
    path = args.output / f'{design.study}.json'
    write_atomically(path, summary.content(found, _software()))
    path.with_suffix('.png').write_bytes(figures.png(found))
    print(f'{design.study}: {what}; {design.trials} trials, seed {design.seed}, {seconds:.1f} s')
    print('\n'.join(summary.table(found)))
    print(f'written to {path} and {path.with_suffix(".png").name}')
    return EXIT_ACCEPTED


def _workers(args: argparse.Namespace) -> int:
    from starcal_ros.studies.workers import processors

    workers: int = processors() if args.workers is None else args.workers
    if not 0 <= workers <= 1024:
        raise OptionError(f'--workers: {workers} is not within 0 to 1024')
    return workers


def _paper(args: argparse.Namespace) -> int:
    """Reproduce the paper."""
    import dataclasses
    import functools

    from starcal_ros.products.files import write_atomically
    from starcal_ros.simulation.scenario import scenario
    from starcal_ros.studies import monte_carlo, paper, paper_figures, summary
    from starcal_ros.studies.workers import run_each, run_trials

    workers = _workers(args)
    table1 = dataclasses.replace(
        paper.TABLE_1, seed=args.seed, trials=args.trials or paper.TABLE_1.trials
    )
    monte_carlo.check(table1)
    images = scenario(paper.NIGHT, args.seed).image_count
    _make_folder(args.output / 'images')
    with progress_bar(images, 'frames') as advance:
        frame = functools.partial(paper.observe_frame, args.seed)
        frames = run_each(frame, images, workers, args.scheduler, advance)
    with progress_bar(table1.trials, 'trials') as advance:
        rows = run_trials(table1, workers, args.scheduler, advance)
    observations = [observed for _, observed in sorted(frames, key=lambda item: item[0])]
    found = paper.study(observations, summary.conclude(table1, rows), args.seed)
    for name, png in paper_figures.pngs(found).items():
        write_atomically(args.output / 'images' / f'paper_{name}.png', png)
    path = args.output / 'paper.md'
    write_atomically(path, paper.page(found, _software()))
    content = {'software': _software(), **paper.numbers(found)}
    write_atomically(path.with_suffix('.json'), json.dumps(content, indent=1) + '\n')
    print(f'written to {path}, with figures in {args.output / "images"}')
    return EXIT_ACCEPTED


def _software() -> str:
    from starcal_ros.pipeline.provenance import software_version

    return f'starcal {software_version()}'


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f'{path}: cannot create the folder: {error.strerror}') from error


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    'demo': _demo,
    'inspect': _inspect,
    'diagnose': _diagnose,
    'calibrate': _calibrate,
    'report': _report,
    'compare': _compare,
    'lookup': _lookup,
    'play': _play,
    'simulate': _simulate,
    'campaign': _campaign,
    **mission.COMMANDS,
}


if __name__ == '__main__':
    sys.exit(main())
