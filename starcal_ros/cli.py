"""
The `starcal` tool: the package's functions from a shell.

Exit status: 0 a calibration passed the gate (or the command did its work); 3 solved but refused by
the gate, products written; 2 bad input, one line on stderr; 130 interrupted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
import contextlib
import os
from pathlib import Path
import sys
from typing import NoReturn, TYPE_CHECKING, TypeVar

from starcal_ros.errors import OptionError, StarcalError, TooFewObservations

# numpy, scipy, OpenCV and the like cost a second to import: each command takes what it needs, so
# that --help answers at once.
if TYPE_CHECKING:
    from starcal_ros.pipeline import Setup
    from starcal_ros.records import Calibration, CameraGeometry, Ensemble, StarObservations

T = TypeVar('T')

EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_INTERRUPTED = 0, 2, 3, 130
NODES = ('star_observer', 'calibrator')
_DEMO_SIGMAS = 5.0  # one in 10^5 demos would miss by chance; the seed is fixed, so none does


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns the exit status."""
    try:
        args = _parser().parse_args(argv)
        run: Callable[[argparse.Namespace], int] = args.run
        return run(args)
    except StarcalError as error:
        return _complain(str(error))
    except BrokenPipeError:
        # The reader of our output has gone (starcal ... | head): nothing more to say to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BAD_INPUT
    except OSError as error:
        return _complain(f'{error.filename or "input/output"}: {error.strerror or error}')
    except KeyboardInterrupt:
        _complain('interrupted')
        return EXIT_INTERRUPTED


def _complain(text: str) -> int:
    print(f'starcal: {" ".join(text.split())}', file=sys.stderr)
    return EXIT_BAD_INPUT


class _Parser(argparse.ArgumentParser):
    """Complains in one line, like everything else here."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        self.exit(_complain(message))


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog='starcal', description='In-flight star calibration of spacecraft cameras.'
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')

    demo = commands.add_parser('demo', help='calibrate the small bag with the real ROS nodes')
    demo.add_argument('-o', '--output', type=Path, default=Path('starcal_demo'), metavar='DIR')
    demo.set_defaults(run=_demo)

    calibrate = commands.add_parser('calibrate', help='calibrate from bags, without a ROS graph')
    calibrate.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='.mcap or folder')
    calibrate.add_argument('--params', type=Path, required=True, metavar='FILE')
    calibrate.add_argument('-o', '--output', type=Path, required=True, metavar='DIR')
    for what in ('image', 'attitude', 'velocity', 'temperature', 'observations'):
        calibrate.add_argument(
            f'--{what}-topic', default='', metavar='T', help='the only one of its type if left out'
        )
    calibrate.set_defaults(run=_calibrate)

    play = commands.add_parser('play', help='play a bag on the ROS graph')
    play.add_argument('bag', type=Path, metavar='BAG')
    play.add_argument(
        '--rate',
        type=float,
        default=1.0,
        metavar='R',
        help='times real time; 0: as fast as stars are observed',
    )
    play.add_argument('--remap', action='append', default=[], metavar='A:=B')
    play.set_defaults(run=_play)

    simulate = commands.add_parser('simulate', help='render a bag with known truth')
    simulate.add_argument('-o', '--output', type=Path, required=True, metavar='BAG')
    simulate.add_argument('--scenario', required=True, metavar='NAME')
    simulate.add_argument('--seed', type=int, default=1, metavar='N')
    simulate.set_defaults(run=_simulate)
    _add_campaign(commands.add_parser('campaign', help='Monte Carlo studies of calibrations'))
    return parser


def _add_campaign(campaign: argparse.ArgumentParser) -> None:
    campaign.add_argument('study', metavar='STUDY', help='table1, images, terms or coverage')
    campaign.add_argument('-o', '--output', type=Path, required=True, metavar='DIR')
    campaign.add_argument('--trials', type=int, metavar='N')
    campaign.add_argument('--seed', type=int, default=1, metavar='N')
    for name, kind, metavar, what in (
        ('images', int, 'M', 'images of a calibration'),
        ('stars', int, 'N', 'stars of an image'),
        ('tracker', float, 'ARCSEC', 'star tracker noise about each axis'),
        ('methods', str, 'METHOD', 'per_image, single, hierarchical'),
    ):
        campaign.add_argument(f'--{name}', type=kind, nargs='+', metavar=metavar, help=what)
    campaign.add_argument(
        '--tracker-told', type=float, metavar='ARCSEC', help='what the calibration takes it for'
    )
    where = campaign.add_mutually_exclusive_group()
    where.add_argument(
        '--workers', type=int, metavar='N', help='processes; 0: none but this; all processors'
    )
    where.add_argument('--scheduler', default='', metavar='ADDRESS', help='of a Dask cluster')
    campaign.set_defaults(run=_campaign)


def _calibrate(args: argparse.Namespace) -> int:
    """Bags to products: what the two nodes do, in one process."""
    from starcal_ros import bag, pipeline, products
    from starcal_ros.node_options import NODE_OPTION_CLASSES
    from starcal_ros.options import read_parameter_file
    from starcal_ros.records import Ensemble

    values = read_parameter_file(args.params, NODES)
    setup = pipeline.load_setup(
        products.with_camera_url_from(values, args.params),
        others=NODE_OPTION_CLASSES,
    )
    if args.output.exists() and not args.output.is_dir():
        raise OptionError(f'{args.output}: not a folder')
    records, total = _observations(args, setup)
    observations = list(_progress(records, total, 'images'))
    ensemble = Ensemble()
    for record in observations:
        ensemble = pipeline.add_to_ensemble(ensemble, record, setup)
    _make_folder(args.output)
    # After all reading: the bag may be the observations.mcap of an earlier run in this folder.
    with bag.BagWriter(args.output / 'observations.mcap') as writer:
        for record in observations:
            writer.write_observations('/observations', record, setup.frames.camera_frame)
    inputs = {str(path): _digest(path) for path in (*bag.mcap_files(args.bags), args.params)}
    try:
        calibration = pipeline.solve(ensemble, setup, inputs=inputs)
    except TooFewObservations as error:
        raise TooFewObservations(f'{error}{_refused_words(ensemble)}') from error
    products.write_calibration(calibration, args.output / products.CALIBRATION_FILE)
    products.write_camera_info(
        calibration.geometry.camera, args.output / products.CAMERA_INFO_FILE
    )
    print('\n'.join(_summary(calibration, setup.prior)))
    print(f'written to {args.output}')
    return EXIT_ACCEPTED if calibration.accepted else EXIT_REFUSED


def _refused_words(ensemble: Ensemble) -> str:
    counted = ', '.join(f'{reason} {count}' for reason, count in ensemble.refused.items())
    return f' ({counted})' if counted else ''


def _observations(
    args: argparse.Namespace, setup: Setup
) -> tuple[Iterable[StarObservations], int]:
    """Observations of the bags, measured in images or as recorded, and how many there are."""
    from starcal_ros import bag, messages, pipeline

    there = bag.topics(args.bags)
    types = {topic.type_name for topic in there}
    counts = {topic.name: topic.count for topic in there}
    image_types = [t for t in (messages.IMAGE_TYPE, messages.COMPRESSED_TYPE) if t in types]
    only_recorded = not image_types and messages.OBSERVATIONS_TYPE in types
    if args.observations_topic or (only_recorded and not args.image_topic):
        topic = bag.choose_topic(args.bags, messages.OBSERVATIONS_TYPE, args.observations_topic)
        return bag.read_observations(args.bags, topic), counts[topic]
    image_type = next(iter(image_types), messages.IMAGE_TYPE)
    for kind in image_types:
        if any(
            t.type_name == kind and t.name == f'/{args.image_topic.lstrip("/")}' for t in there
        ):
            image_type = kind
    image_topic = bag.choose_topic(args.bags, image_type, args.image_topic)
    attitude_topic = bag.choose_topic(args.bags, messages.ATTITUDE_TYPE, args.attitude_topic)
    velocity_topic = args.velocity_topic
    if velocity_topic or messages.VELOCITY_TYPE in types:
        velocity_topic = bag.choose_topic(args.bags, messages.VELOCITY_TYPE, velocity_topic)
    temperature_topic = args.temperature_topic
    options = setup.calibration
    asked = options.focal_temperature_order or options.alignment_temperature
    thermometers = sum(topic.type_name == messages.TEMPERATURE_TYPE for topic in there)
    # A spacecraft has many: which one is the camera's matters only where it is made use of.
    if temperature_topic or thermometers == 1 or (thermometers and asked):
        temperature_topic = bag.choose_topic(
            args.bags, messages.TEMPERATURE_TYPE, temperature_topic
        )
    return (
        pipeline.observe_bag(
            args.bags, image_topic, attitude_topic, setup, velocity_topic, temperature_topic
        ),
        counts[image_topic],
    )


def _play(args: argparse.Namespace) -> int:
    """Become the bag player."""
    from starcal_ros import bag, demo

    bag.mcap_files([args.bag])
    if not 0 <= args.rate <= 1e6:
        raise OptionError(f'--rate: {args.rate} is not within 0 to 1e6')
    for remap in args.remap:
        if not all(remap.partition(':=')[::2]):
            raise OptionError(f'--remap: {remap!r} is not A:=B')
    sys.stdout.flush()
    os.execv(sys.executable, demo.player_command(args.bag, args.rate, args.remap))


def _simulate(args: argparse.Namespace) -> int:
    """Render a named scenario."""
    from starcal_ros import simulation, synthetic

    if args.scenario not in synthetic.SCENARIOS:
        known = ', '.join(synthetic.SCENARIOS)
        raise OptionError(f'--scenario: {args.scenario!r} is not one of {known}')
    if args.seed < 0:
        raise OptionError(f'--seed: {args.seed} is not 0 or more')
    scenario = synthetic.scenario(args.scenario, args.seed)
    with _progress_bar(scenario.image_count, 'images') as advance:
        made = simulation.write_bag(scenario, args.output, on_image=lambda _: advance())
    print(f'bag {made.bag}, {scenario.image_count} images, seed {args.seed}')
    print(f'truth {made.truth}')
    print(f'calibrate it with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return EXIT_ACCEPTED


def _demo(args: argparse.Namespace) -> int:
    """Calibrate the small bag with the real nodes and hold the result against the truth."""
    from starcal_ros import demo, products

    _make_folder(args.output)
    bag = demo.tiny_bag(args.output)
    print(f'bag {bag.bag}; log files and products go to {args.output}')
    with _progress_bar(bag.image_count, 'images') as advance:
        calibration, verdict = demo.run(bag, args.output, on_image=advance)
    print(verdict)
    if calibration is None:
        return EXIT_REFUSED
    products.write_calibration(calibration, args.output / products.CALIBRATION_FILE)
    products.write_camera_info(
        calibration.geometry.camera, args.output / products.CAMERA_INFO_FILE
    )
    comparison = demo.compare(calibration, bag.truth, bag.prior)
    print('\n'.join(comparison.lines))
    good = comparison.worst_sigmas <= _DEMO_SIGMAS
    print(
        f'the farthest from the truth is {comparison.worst_sigmas:.1f} sigma off, '
        + ('as chance has it' if good else f'over {_DEMO_SIGMAS:g}: something is wrong')
    )
    return EXIT_ACCEPTED if good else EXIT_REFUSED


def _campaign(args: argparse.Namespace) -> int:
    """Run a Monte Carlo study."""
    # One thread each: trials go side by side, and numbers must not hang on how many there are.
    os.environ.update(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1')
    import dataclasses
    import time

    from starcal_ros import campaign, campaign_figures, campaign_workers, pipeline, products

    if args.study not in campaign.STUDIES:
        raise OptionError(f'STUDY: {args.study!r} is not one of {", ".join(campaign.STUDIES)}')
    what, usual = campaign.STUDIES[args.study]
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
    campaign.check(design)
    workers = campaign_workers.processors() if args.workers is None else args.workers
    if not 0 <= workers <= 1024:
        raise OptionError(f'--workers: {workers} is not within 0 to 1024')
    _make_folder(args.output)
    start = time.monotonic()
    with _progress_bar(design.trials, 'trials') as advance:
        rows = campaign_workers.run_trials(design, workers, args.scheduler, advance)
    seconds = time.monotonic() - start
    found = campaign.conclude(design, rows)
    path = args.output / f'{design.study}.json'
    software = f'starcal {pipeline.software_version()}'
    products.write_atomically(path, campaign.content(found, software))
    path.with_suffix('.png').write_bytes(campaign_figures.png(found))
    print(f'{design.study}: {what}; {design.trials} trials, seed {design.seed}, {seconds:.1f} s')
    print('\n'.join(campaign.table(found)))
    print(f'written to {path} and {path.with_suffix(".png").name}')
    return EXIT_ACCEPTED


def _summary(calibration: Calibration, prior: CameraGeometry) -> list[str]:
    """What a person wants to know of a calibration, as lines."""
    import numpy as np

    from starcal_ros.camera import PARAMETER_NAMES
    from starcal_ros.constants import ARCSECOND_RAD
    from starcal_ros.demo import alignment_difference_rad
    from starcal_ros.thermal import summary as thermal_summary

    camera, sigma = calibration.geometry.camera, calibration.sigma
    lines = [f'{"parameter":<14}{"value":>16}{"1-sigma":>12}{"from prior":>14}']
    for k, name in enumerate(PARAMETER_NAMES):
        value, change = camera.parameters[k], camera.parameters[k] - prior.camera.parameters[k]
        error = f'{sigma[k]:.2g}' if name in calibration.estimated else 'held'
        lines.append(f'{name:<14}{value:>16.8g}{error:>12}{change:>+14.4g}')
    angles = alignment_difference_rad(calibration.geometry, prior) / ARCSECOND_RAD
    for axis, angle, error in zip('xyz', angles, sigma[10:] / ARCSECOND_RAD, strict=True):
        lines.append(f'{"alignment " + axis:<14}{"":>16}{error:>11.2f}"{angle:>+13.2f}"')
    quaternion = calibration.geometry.star_tracker_from_camera_xyzw
    lines.append(f'alignment xyzw  {np.array2string(quaternion, precision=9, separator=", ")}')
    refused = ', '.join(f'{n} {reason}' for reason, n in calibration.images_refused.items())
    lines += [
        f'images          {calibration.images_used} used, refused: {refused or "none"}',
        f'stars           {calibration.stars_used} used, {calibration.stars_rejected} rejected',
        f'residual        {calibration.residual_rms_px:.4f} px rms per axis',
        f'method          {calibration.method}',
        f'solver          {calibration.iterations} iterations, {calibration.termination}',
    ]
    if calibration.thermal is not None:
        lines.append(f'temperature     {thermal_summary(calibration.thermal)}')
    verdict = 'accepted' if calibration.accepted else 'refused: ' + '; '.join(calibration.reasons)
    return [*lines, f'verdict         {verdict}']


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


@contextlib.contextmanager
def _progress_bar(total: int, what: str) -> Iterator[Callable[[], None]]:
    """A bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda: progress.advance(task)


def _progress(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    with _progress_bar(total, what) as advance:
        for item in items:
            yield item
            advance()


if __name__ == '__main__':
    sys.exit(main())
