# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
r"""
Propose the next pointings of the camera.

Calibrates the images so far, as starcal calibrate does. Then it chooses the allowed pointings one
by one, each time the one that lowers a sigma most, and prints the sigma expected after it.

  # the next ten images, anywhere on the sky
  starcal plan bags/tiny
  # five images, within 60 degrees of the zenith of Houston, away from the Sun
  starcal plan bags/tiny --params bags/tiny/params.yaml --images 5 \
      --within 250 30 60 --avoid 83 23 40 -o pointings.csv
"""

from __future__ import annotations

import argparse
import csv
import io
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments, terminal
from starcal_ros import errors, text, untrusted

if TYPE_CHECKING:
    from starcal_ground.planning.plan import Plan, Pointing

_COLUMNS = ('ra_deg', 'dec_deg', 'roll_deg')


def add_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    arguments.add_inputs(command)
    images = arguments.number(int, 1, 1000)
    what = 'images that may be taken (default: 10)'
    add('--images', type=images, default=10, metavar='N', help=what)
    what = (
        'sigma to lower, by the names of --require: line_of_sight (default), map, pointing, f, or'
        ' a parameter such as k1; rms over the detector, and of both focal lengths'
    )
    add('--minimise', default='line_of_sight', metavar='NAME', help=what)
    allowed = command.add_mutually_exclusive_group()
    what = 'CSV of the allowed pointings, with the columns ra_deg, dec_deg and, if fixed, roll_deg'
    allowed.add_argument('--pointings', type=arguments.path, metavar='FILE', help=what)
    cone = ('RA', 'DEC', 'DEG')
    what = 'allow boresights within DEG degrees of a direction, ICRF (default: the whole sky)'
    whole = (0.0, 0.0, 180.0)
    allowed.add_argument('--within', type=float, nargs=3, default=whole, metavar=cone, help=what)
    what = 'no boresight within DEG degrees of a direction: Sun, Moon, Earth; may be repeated'
    add('--avoid', type=float, nargs=3, action='append', default=[], metavar=cone, help=what)
    slew = arguments.number(float, 0.001, 180)
    what = 'largest angle between the boresights of an image and the next (default: 180)'
    add('--slew', type=slew, default=180.0, metavar='DEG', help=what)
    arguments.add_output(command, 'FILE', 'write the pointings as CSV too')
    arguments.add_json(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.bags import reader
    from starcal_ground.campaign import calibrate, chosen, observe
    from starcal_ground.images.first_setup import source_of
    from starcal_ground.planning.plan import Cone, plan_pointings, PlanRequest
    from starcal_ground.written_files import write_marked

    given = arguments.given(args)
    _, stated = given.checked
    if args.output:
        read = given.photographs or reader.files_of_bags(given.paths)
        files = [*stated, *read, *filter(None, [args.pointings])]
        arguments.check_file(args.output, files)
    request = PlanRequest(
        args.images,
        args.minimise,
        _pointings(args.pointings) if args.pointings else (),
        Cone(*args.within),
        tuple(Cone(*cone) for cone in args.avoid),
        args.slew,
    )
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        source = source_of(given, Path(name), Path(name), arguments.print_notes)
        campaign = calibrate(observe(chosen(source)))
    arguments.print_notes(campaign.notes)
    plan = plan_pointings(campaign.ensemble, campaign.setup, request)
    if args.output:
        write_marked(args.output, _csv(plan))
    if args.json:
        arguments.print_json(plan)
        return arguments.EXIT_ACCEPTED
    terminal.print_table(*_table(plan), left=0)
    if plan.enough is not None:
        after = f'after image {plan.enough} another' if plan.enough else 'another image'
        terminal.print_text(f'{after} lowers the sigma by less than 1 %')
    if len(plan.steps) < args.images:
        terminal.print_text(f'no other pointing can be reached after image {len(plan.steps)}')
    if args.output:
        terminal.print_text(f'pointings written to {args.output}')
    return arguments.EXIT_ACCEPTED


def _pointings(path: Path) -> tuple[Pointing, ...]:
    """Return the rows of a file of pointings."""
    from starcal_ground.planning.plan import Pointing

    with errors.errors_as(errors.OptionError, path):
        rows = csv.DictReader(io.StringIO(untrusted.read_text(path, untrusted.PRODUCT_BYTES)))
    try:
        lacking = [name for name in _COLUMNS[:2] if name not in (rows.fieldnames or ())]
        if lacking:
            raise errors.OptionError(f'{path}: no column {" and ".join(lacking)}')
        pointings = [Pointing(*(float(row.get(name) or 0.0) for name in _COLUMNS)) for row in rows]
    except (TypeError, ValueError, csv.Error) as error:
        raise errors.OptionError(f'{path}: line {rows.line_num}: {error}') from error
    if not pointings:
        raise errors.OptionError(f'{path}: no pointings')
    return tuple(pointings)


def _csv(plan: Plan) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow([*_COLUMNS, 'stars', plan.name])
    for step in plan.steps:
        place = step.pointing
        angles = [f'{a:.4f}' for a in (place.ra_deg, place.dec_deg, place.roll_deg)]
        writer.writerow([*angles, step.stars, f'{step.sigma:.6g}'])
    return text.getvalue()


def _table(plan: Plan) -> tuple[list[str], list[list[str]]]:
    header = ['image', *_COLUMNS, 'stars', plan.name]
    rows = [['now', '', '', '', '', text.significant(plan.sigma, 4)]]
    for k, step in enumerate(plan.steps, 1):
        place = step.pointing
        angles = [f'{deg:.3f}' for deg in (place.ra_deg, place.dec_deg, place.roll_deg)]
        rows.append([str(k), *angles, str(step.stars), text.significant(step.sigma, 4)])
    return header, rows
