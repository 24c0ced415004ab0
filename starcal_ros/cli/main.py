"""
The `starcal` tool: the package's functions from a shell.

Exit status: 0 a calibration passed the gate (or the command did its work); 3 solved but refused by
the gate, products written, or a bag that cannot be calibrated; 2 bad input, one line on stderr;
130 interrupted.
"""

# PYTHON_ARGCOMPLETE_OK: what completes the tool's arguments in a shell looks for this word.
from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import dataclasses
import json
import os
from pathlib import Path
import sys
from typing import TYPE_CHECKING

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

# numpy, scipy, OpenCV and the like cost a second to import: each command takes what it needs, so
# that --help answers at once.
if TYPE_CHECKING:
    from starcal_ros.pipeline.setup import Setup
    from starcal_ros.pipeline.topics import Topics
    from starcal_ros.records import Calibration, Ensemble

NODES = ('star_observer', 'calibrator')
_DEMO_SAME_PX = 1e-6  # what other threads of BLAS may do to the last digits
_DEMO_SIGMAS = 5.0  # one in 10^5 demos would miss by chance; the seed is fixed, so none does


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns the exit status."""
    try:
        made = parser()
        if '_ARGCOMPLETE' in os.environ:  # a shell asks what may come next
            import argcomplete

            argcomplete.autocomplete(made)
        args = made.parse_args(argv)
        return _COMMANDS[args.command](args)
    except StarcalError as error:
        return complain(str(error))
    except BrokenPipeError:
        # The reader of our output has gone (starcal ... | head): nothing more to say to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BAD_INPUT
    except OSError as error:
        return complain(f'{error.filename or "input/output"}: {error.strerror or error}')
    except KeyboardInterrupt:
        complain('interrupted')
        return EXIT_INTERRUPTED


def _calibrate(args: argparse.Namespace) -> int:
    """Bags to products: what the two nodes do, in one process."""
    from starcal_ros.bag import reader
    from starcal_ros.cli import output
    from starcal_ros.report import page

    setup = _setup(args.params)
    if args.output.exists() and not args.output.is_dir():
        raise OptionError(f'{args.output}: not a folder')
    inputs = {str(path): _digest(path) for path in (*reader.mcap_files(args.bags), args.params)}
    calibration = _calibrate_into(args.output, args.bags, _asked(args), setup, inputs)
    shown = page.write_report(args.output)
    output.print_calibration(calibration, setup.prior)
    print(f'written to {args.output}; look at {shown}')
    return EXIT_ACCEPTED if calibration.accepted else EXIT_REFUSED


def _calibrate_into(
    folder: Path, bags: Sequence[Path], asked: Topics, setup: Setup, inputs: Mapping[str, str]
) -> Calibration:
    """Calibrate from bags; all that a report is made from goes into the folder."""
    from starcal_ros.bag import reader
    from starcal_ros.pipeline import solve
    from starcal_ros.pipeline import topics as bag_topics
    from starcal_ros.products.files import OBSERVATIONS_FILE
    from starcal_ros.products.residuals_npz import RESIDUALS_FILE, write_residuals
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
    with reader.BagWriter(folder / OBSERVATIONS_FILE) as writer:
        for record in observations:
            writer.write_observations('/observations', record, setup.frames.camera_frame)
    try:
        calibration, left = solve.solve_with_residuals(ensemble, setup, inputs=inputs)
    except TooFewObservations as error:
        words = f'{error}{_refused_words(ensemble)}'
        if topics.image and not ensemble.images:
            from starcal_ros.cli import diagnosis

            words = f'{words}. {diagnosis.in_a_sentence(bags, asked, setup)}'
        raise TooFewObservations(words.removesuffix('. ')) from error
    _write_products(calibration, folder)
    write_residuals(left, folder / RESIDUALS_FILE)
    thumbnails.write_thumbnails(album.thumbnails(), folder / thumbnails.THUMBNAILS_FOLDER)
    return calibration


def _setup(params: Path) -> Setup:
    """Every option of a parameter file, and what they name, loaded."""
    from starcal_ros.options import read_parameter_file
    from starcal_ros.pipeline.node_options import NODE_OPTION_CLASSES
    from starcal_ros.pipeline.setup import load_setup
    from starcal_ros.products.camera_yaml import with_camera_url_from

    values = with_camera_url_from(read_parameter_file(params, NODES), params)
    try:
        return load_setup(values, others=NODE_OPTION_CLASSES)
    except OptionError as error:
        raise OptionError(f'{params}: {error}') from error


def _asked(args: argparse.Namespace) -> Topics:
    from starcal_ros.pipeline.topics import Topics

    return Topics(
        image=args.image_topic,
        attitude=args.attitude_topic,
        velocity=args.velocity_topic,
        temperature=args.temperature_topic,
        observations=args.observations_topic,
    )


def _write_products(calibration: Calibration, folder: Path) -> None:
    from starcal_ros.products import calibration_json
    from starcal_ros.products.calibration_json import write_calibration
    from starcal_ros.products.camera_yaml import CAMERA_INFO_FILE, write_camera_info

    write_calibration(calibration, folder / calibration_json.CALIBRATION_FILE)
    write_camera_info(calibration.geometry.camera, folder / CAMERA_INFO_FILE)


def _report(args: argparse.Namespace) -> int:
    """Write the report of a folder anew."""
    from starcal_ros.report import page

    print(f'written to {page.write_report(args.folder)}')
    return EXIT_ACCEPTED


def _refused_words(ensemble: Ensemble) -> str:
    counted = ', '.join(f'{reason} {count}' for reason, count in ensemble.refused.items())
    return f' ({counted})' if counted else ''


def _inspect(args: argparse.Namespace) -> int:
    """Say what a bag holds."""
    from starcal_ros.bag import reader
    from starcal_ros.cli import output
    from starcal_ros.messages.types import COMPRESSED_TYPE, IMAGE_TYPE, OBSERVATIONS_TYPE
    from starcal_ros.pipeline import inspect

    setup = _setup(args.params) if args.params else None
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

    found = diagnosis.of_bags(args.bags, _asked(args), _setup(args.params))
    if args.json:
        print(json.dumps(diagnosis.content(found), indent=1, allow_nan=False))
    else:
        print(diagnosis.text(found))
    return EXIT_ACCEPTED if found.cause == 'none' else EXIT_REFUSED


def _compare(args: argparse.Namespace) -> int:
    """Say how far two calibrations are apart."""
    from starcal_ros.assessment import comparison
    from starcal_ros.cli import output
    from starcal_ros.products.calibration_json import read_calibration
    from starcal_ros.report import comparison_figure

    found = comparison.compare(*(read_calibration(_file(p)) for p in (args.a, args.b)))
    if args.output:
        comparison_figure.write(found, args.output)
    if args.json:
        print(json.dumps(comparison.content(found), indent=1, allow_nan=False))
    else:
        output.print_comparison(found)
        if args.output:
            print(f'written to {args.output}')
    return EXIT_ACCEPTED


def _file(path: Path) -> Path:
    """The calibration of a folder, or the file itself."""
    from starcal_ros.products.calibration_json import CALIBRATION_FILE

    if not path.is_dir():
        return path
    if not (path / CALIBRATION_FILE).exists():
        raise OptionError(f'{path}: no {CALIBRATION_FILE} in the folder')
    return path / CALIBRATION_FILE


def _play(args: argparse.Namespace) -> int:
    """Become the bag player."""
    from starcal_ros.bag import reader
    from starcal_ros.cli import demo

    reader.mcap_files([args.bag])
    if not 0 <= args.rate <= 1e6:
        raise OptionError(f'--rate: {args.rate} is not within 0 to 1e6')
    for remap in args.remap:
        if not all(remap.partition(':=')[::2]):
            raise OptionError(f'--remap: {remap!r} is not A:=B')
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
        raise OptionError(f'--seed: {args.seed} is not 0 or more')
    scenario = synthetic.scenario(args.scenario, args.seed)
    with progress_bar(scenario.image_count, 'images') as advance:
        made = simulated_bag.write_bag(scenario, args.output, on_image=lambda _: advance())
    print(f'bag {made.bag}, {scenario.image_count} images, seed {args.seed}')
    print(f'truth {made.truth}')
    print(f'calibrate it with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return EXIT_ACCEPTED


def _demo(args: argparse.Namespace) -> int:
    """Calibrate the small bag with the real nodes and hold the result against the truth."""
    from starcal_ros.assessment import comparison
    from starcal_ros.cli import demo
    from starcal_ros.pipeline.setup import load_setup
    from starcal_ros.pipeline.topics import Topics
    from starcal_ros.report import page

    _make_folder(args.output)
    bag = demo.tiny_bag(args.output)
    print(f'bag {bag.bag}; log files and products go to {args.output}')
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
        f'the farthest from the truth is {beside_truth.worst_sigmas:.1f} sigma off, '
        + ('as chance has it' if good else f'over {_DEMO_SIGMAS:g}: something is wrong'),
    )
    # Nodes tell no residuals. The tool's are theirs where it finds the same calibration.
    setup = load_setup(bag.parameters)
    again = _calibrate_into(args.output, [bag.bag], Topics(), setup, {})
    _write_products(calibration, args.output)
    apart_px = float(comparison.compare(calibration, again).before.length_px.max())
    same = apart_px <= _DEMO_SAME_PX
    print_verdict(
        same,
        'the tool finds the same from the bag without a graph'
        if same
        else f'the tool finds another calibration from the same bag: {apart_px:.2g} px apart',
    )
    print(f'look at {page.write_report(args.output)}')
    good = good and same
    return EXIT_ACCEPTED if good else EXIT_REFUSED


def _campaign(args: argparse.Namespace) -> int:
    """Run a Monte Carlo study."""
    # One thread each: trials go side by side, and numbers must not hang on how many there are.
    os.environ.update(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1')
    import time

    from starcal_ros.options import nearest
    from starcal_ros.pipeline import provenance
    from starcal_ros.products.files import write_atomically
    from starcal_ros.studies import figures as study_figures
    from starcal_ros.studies import monte_carlo
    from starcal_ros.studies import workers as campaign_workers

    if args.study == 'paper':
        return _paper(args)
    if args.study not in monte_carlo.STUDIES:
        studies = (*monte_carlo.STUDIES, 'paper')
        known = ', '.join(studies) + nearest(args.study, studies)
        raise OptionError(f'STUDY: {args.study!r} is not one of {known}')
    what, usual = monte_carlo.STUDIES[args.study]
    design = dataclasses.replace(
        usual,
        trials=usual.trials if args.trials is None else args.trials,
        seed=args.seed,
        images=tuple(args.images or usual.images),
        stars=tuple(args.stars or usual.stars),
        tracker_arcsec=tuple(args.tracker or usual.tracker_arcsec),
        methods=tuple(args.methods or usual.methods),
        told_arcsec=args.tracker_told,
    )
    monte_carlo.check(design)
    workers = _workers(args)
    _make_folder(args.output)
    start = time.monotonic()
    with progress_bar(design.trials, 'trials') as advance:
        rows = campaign_workers.run_trials(design, workers, args.scheduler, advance)
    seconds = time.monotonic() - start
    found = monte_carlo.conclude(design, rows)
    path = args.output / f'{design.study}.json'
    software = f'starcal {provenance.software_version()}'
    write_atomically(path, monte_carlo.content(found, software))
    path.with_suffix('.png').write_bytes(study_figures.png(found))
    print(f'{design.study}: {what}; {design.trials} trials, seed {design.seed}, {seconds:.1f} s')
    print('\n'.join(monte_carlo.table(found)))
    print(f'written to {path} and {path.with_suffix(".png").name}')
    return EXIT_ACCEPTED


def _workers(args: argparse.Namespace) -> int:
    from starcal_ros.studies.workers import processors

    workers: int = processors() if args.workers is None else args.workers
    if not 0 <= workers <= 1024:
        raise OptionError(f'--workers: {workers} is not within 0 to 1024')
    return workers


def _paper(args: argparse.Namespace) -> int:
    """Show the paper again."""
    import functools

    from starcal_ros.pipeline import provenance
    from starcal_ros.products.files import write_atomically
    from starcal_ros.simulation.scenario import scenario
    from starcal_ros.studies import monte_carlo, paper, paper_figures
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
    observations = [frames_at for _, frames_at in sorted(frames, key=lambda item: item[0])]
    found = paper.study(observations, monte_carlo.conclude(table1, rows), args.seed)
    software = f'starcal {provenance.software_version()}'
    for name, png in paper_figures.pngs(found).items():
        write_atomically(args.output / 'images' / f'paper_{name}.png', png)
    path = args.output / 'paper.md'
    write_atomically(path, paper.page(found, software))
    content = {'software': software, **paper.numbers(found)}
    write_atomically(path.with_suffix('.json'), json.dumps(content, indent=1) + '\n')
    print(f'written to {path}, with figures in {args.output / "images"}')
    return EXIT_ACCEPTED


def _digest(path: Path) -> str:
    import hashlib

    digest = hashlib.sha256()
    with path.open('rb') as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return f'sha256:{digest.hexdigest()}'


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f'{path}: cannot be made: {error.strerror}') from error


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    'demo': _demo,
    'inspect': _inspect,
    'diagnose': _diagnose,
    'calibrate': _calibrate,
    'report': _report,
    'compare': _compare,
    'play': _play,
    'simulate': _simulate,
    'campaign': _campaign,
}


if __name__ == '__main__':
    sys.exit(main())
