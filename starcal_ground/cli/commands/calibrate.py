# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibrate from bags or images, with what is known of them, without a ROS graph.

Measures the stars of all images, estimates camera and alignment, checks the result against the
limits of the gate and writes report.html, calibration.json, camera_info.yaml and observations.mcap
to DIR. What is not stated (--params, --set) is found by the stars or assumed, and listed; a camera
that was found is in DIR as params.yaml and camera.yaml. Images without attitudes give the camera
alone.

  # the bag in the repository, of which nothing is stated
  starcal calibrate bags/tiny -o found
  # with its parameter file, and an accuracy to reach
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out --require map=1arcsec@98%
  # photographs of the night sky alone, with a lens model
  starcal calibrate 'night/*.jpg' -o out --set lens_model=plumb_bob
  # the images of the first 30 s
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out --to +30
  # one of several cameras, from two bags together
  starcal calibrate night1 night2.mcap --params camera1.yaml -o out --image-topic /camera1/image
  # repeat from the recorded observations, with other options and without images
  starcal calibrate out/observations.mcap --params bags/tiny/params.yaml -o again
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments
from starcal_ground.cli.terminal import print_table, print_text, print_verdict, print_wrapped
from starcal_ros.errors import NotFromStars, OptionError
from starcal_ros.text import significant

if TYPE_CHECKING:
    from starcal_ground.campaign import Campaign, Source
    from starcal_ros.records import Calibration, CameraGeometry

_DIR = 'folder for the products, created if absent'
_ANSWERED = (
    *('accepted', 'reasons', 'images_used', 'images_refused', 'stars_used', 'residual_rms_px'),
    'statements',
)


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_inputs(command)
    arguments.add_output(command, 'DIR', f'{_DIR} (needed)')
    what = (
        'a sigma to reach, such as line_of_sight=5arcsec@98%%, map=0.1px, pointing=10arcsec or'
        ' f=0.1px, in place of the option requirements; may be repeated; none: no requirement'
    )
    command.add_argument('--require', action='append', metavar='NAME=LIMIT', help=what)
    what = 'write no report; starcal report DIR writes it later'
    command.add_argument('--no-report', action='store_true', help=what)
    when = 'UTC in ISO 8601, seconds since 1970, or +seconds after the first image'
    for name, what in (('from', f'use images from T on: {when}'), ('to', 'use images up to T')):
        command.add_argument(
            f'--{name}', dest=f'{name}_time', type=arguments.parse_time, metavar='T', help=what
        )
    shown = command.add_mutually_exclusive_group()
    arguments.add_json(shown)
    what = 'print nothing but errors; the exit status is the verdict'
    shown.add_argument('--quiet', action='store_true', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.cli import into_folder
    from starcal_ground.images.first_setup import assumed
    from starcal_ground.products import has_stated_prior

    if args.output is None:
        raise OptionError(f'-o/--output DIR: not given: the {_DIR}, e.g. -o out')
    if args.output.exists() and not args.output.is_dir():
        raise OptionError(f'{args.output}: not a folder')
    with tempfile.TemporaryDirectory(prefix='starcal_') as folder:
        source, stated = _source(args, Path(folder))
        with into_folder.digests(source.files) as inputs:
            selection = None
            if args.from_time or args.to_time:
                selection = arguments.Selection(args.from_time, args.to_time)
            made, report = into_folder.calibrate_into(
                args.output, source, inputs, selection, not args.no_report
            )
    if not args.quiet:
        arguments.print_notes(made.notes[len(source.notes) :])
    if args.json:
        arguments.print_json(answer_of(made, source, stated, args.output))
    elif not args.quiet:
        is_stated = has_stated_prior(made.calibration)
        print_calibration(made.calibration, made.setup.prior if is_stated else None)
        _print_assumed(assumed(source, stated, made.ensemble), made.calibration)
        print_text(f'\nproducts written to {args.output}' + (f'\n{report}' if report else ''))
        _print_verdict(made.calibration)
    accepted = made.calibration.accepted
    return arguments.EXIT_ACCEPTED if accepted else arguments.EXIT_REFUSED


def _source(args: argparse.Namespace, bag_folder: Path) -> tuple[Source, Mapping[str, object]]:
    """The source and the options that the arguments give; a failure is recorded in the folder."""
    from starcal_ground.campaign import chosen
    from starcal_ground.cli.into_folder import check_folder, failure_recorded
    from starcal_ground.images import first_setup
    from starcal_ground.products import check_outputs, make_folder, same_as_one_of
    from starcal_ros.assessment.requirements import requirements_of

    requirements_of(args.require or ())
    given = arguments.given(args, **({'requirements': args.require} if args.require else {}))
    setup, stated = given.checked
    files = [*stated, *given.photographs]
    folders = [path for path in given.paths if path.is_dir()]
    if given.photographs and same_as_one_of(args.output, folders):
        raise OptionError(f'{args.output}: holds the images; choose another folder (-o)')
    check_folder(args.output, [] if given.photographs else given.paths, files)
    if setup is None:  # a long search, whose result must have its place
        names = (first_setup.PARAMETER_FILE, first_setup.CAMERA_FILE)
        if not given.states_camera:
            check_outputs([args.output / name for name in names], files)
        make_folder(args.output)

    def note(notes: Sequence[str]) -> None:
        if not args.quiet:
            arguments.print_notes(notes)

    with failure_recorded(args.output, given.paths, NotFromStars):
        source = first_setup.source_of(given, args.output, bag_folder, note)
    with failure_recorded(args.output, given.paths, OptionError):  # no alignment was found
        source = chosen(source)
    note(source.notes)
    if not given.states_camera:
        first_setup.write_setup(source, given.options, args.output)
    return source, given.options


def answer_of(
    made: Campaign, source: Source, stated: Mapping[str, object], folder: Path
) -> Mapping[str, object]:
    """Object that `--json` prints of a campaign whose products are in a folder."""
    from starcal_ground.images.first_setup import assumed
    from starcal_ground.report import verdict
    from starcal_ros.assessment.requirements import REQUIREMENTS

    calibration = made.calibration
    return {
        **{name: getattr(calibration, name) for name in _ANSWERED},
        'requirements': [check for check in calibration.gate if check.option == REQUIREMENTS],
        'not_checked': [check for check in calibration.gate if check.passed is None],
        'lens_model': calibration.geometry.camera.model,
        'found': made.notes,
        'assumed': dict(assumed(source, stated, made.ensemble)),
        'precision': verdict.precision_sentences(calibration),
        'next_step': verdict.next_step(calibration),
        'folder': str(folder),
    }


def print_calibration(calibration: Calibration, prior: CameraGeometry | None) -> None:
    """Print parameters, statistics and causes of the sigma; changes are relative to the prior."""
    from starcal_ground.products import reasons_in_words
    from starcal_ground.report import verdict

    camera = calibration.geometry.camera
    print_text(f'lens model {camera.model}, {camera.width} x {camera.height} px\n')
    rows = verdict.parameter_rows(calibration, prior)
    angles = verdict.alignment_rows(calibration, prior)
    table = [
        (f'{kind}{row.name}', row.value, unit, row.sigma, row.change, row.change_sigmas)
        for kind, of_kind in (('', rows), ('alignment ', angles))
        for row in of_kind
        for unit in [row.unit.replace('arcsec', '″')]
    ]
    columns = 6 if any(row.change for row in (*rows, *angles)) else 4  # the stars have no prior
    header = ('parameter', 'value', 'unit', '1-sigma', 'from prior', 'in sigmas')
    print_table(header[:columns], [row[:columns] for row in table])
    refused = reasons_in_words(calibration.images_refused)
    lines = [
        ('images', f'{calibration.images_used} used, refused: {refused}'),
        ('stars', f'{calibration.stars_used} used, {calibration.stars_rejected} rejected'),
        ('residual', f'{calibration.residual_rms_px:.4f} px rms per axis'),
    ]
    if not calibration.has_alignment:
        lines.append(('alignment', 'none: attitudes from the stars, the camera alone'))
    if calibration.temperature is not None:
        lines.append(('temperature', verdict.thermal_summary(calibration.temperature)))
    lines += [
        ('tracker', verdict.alignment_summary(tracker)) for tracker in calibration.star_trackers
    ]
    print_text()
    for name, text in lines:
        print_wrapped(f'{name:<12}{text}', 12)
    _print_budget(calibration)


def _print_budget(calibration: Calibration) -> None:
    from starcal_ground.report.verdict import parts_that_matter

    columns = 3 if calibration.has_alignment else 2
    parts = parts_that_matter(calibration.sigma_budget)
    if not parts:
        return
    header = ('1-sigma of lines of sight', 'camera alone', 'with alignment')
    rows = [
        (part.cause, *(f'{significant(sigma, 3, least=0.001)}″' for sigma in sigmas))
        for part in parts
        for sigmas in [(part.map_arcsec, part.pointing_arcsec)]
    ]
    print_text()
    print_table(header[:columns], [row[:columns] for row in rows])


def _print_assumed(assumed: Sequence[tuple[str, str]], calibration: Calibration) -> None:
    """Print what nobody stated, with what stating it would gain."""
    gains = {row.option.split()[0].strip(','): row.gain for row in calibration.statements}
    assumptions = {name: f'assumed {text}' for name, text in assumed}
    names = dict.fromkeys([*assumptions, *gains])
    if names:
        print_text('\nyours to state (--set NAME=VALUE, or in --params):')
    for name in names:
        text = '; '.join(filter(None, [assumptions.get(name), gains.get(name)]))
        print_wrapped(f'  {name}: {text}', 4)


def _print_verdict(calibration: Calibration) -> None:
    """Print the first box of the report."""
    from starcal_ground.report import verdict

    print_text()
    word = 'accepted' if calibration.accepted else 'refused'
    print_verdict(calibration.accepted, f'{word} by the gate')
    for sentence in verdict.in_sentences(calibration):
        print_wrapped(f'  {sentence}', 4)
