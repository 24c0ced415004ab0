# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal plan`: the pointings to take next."""

from __future__ import annotations

import argparse
import csv
import io
import json
from pathlib import Path
import sys

from starcal_ground.cli.arguments import EXIT_ACCEPTED
from starcal_ground.cli.output import check_file
from starcal_ground.cli.terminal import print_table, print_text
from starcal_ground.planning.plan import Cone, Plan, plan_pointings, Pointing, Request
from starcal_ros.errors import errors_as, OptionError
from starcal_ros.formats.bag import reader
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.pipeline.campaign import calibrate_bags
from starcal_ros.pipeline.setup import files_of, read_setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.record_fields import json_object
from starcal_ros.text import significant
from starcal_ros.untrusted import PRODUCT_BYTES, read_text

_COLUMNS = ('ra_deg', 'dec_deg', 'roll_deg')


def plan(args: argparse.Namespace, asked: Topics) -> int:
    """Print the pointings that lower a sigma most, and write them if asked."""
    setup = read_setup(args.params)
    if args.output:
        given = [args.params, *files_of(setup.frames).values(), *filter(None, [args.pointings])]
        check_file(args.output, [*reader.files_of_bags(args.bags), *given])
    request = Request(
        args.images,
        args.minimise,
        _pointings(args.pointings) if args.pointings else (),
        Cone(*args.within),
        tuple(Cone(*one) for one in args.avoid),
        args.slew,
    )
    campaign = calibrate_bags(args.bags, setup, asked)
    for note in campaign.notes:
        print_text(note, file=sys.stderr)
    found = plan_pointings(campaign.ensemble, campaign.setup, request)
    if args.output:
        write_atomically(args.output, _csv(found))
    if args.json:
        print_text(json.dumps(json_object(found), indent=1, allow_nan=False))
        return EXIT_ACCEPTED
    print_table(*_table(found), left=0)
    if found.enough is not None:
        print_text(f'after image {found.enough} another lowers the sigma by less than 1 %')
    print_text(found.in_a_sentence())
    if len(found.steps) < args.images:
        print_text(f'no other pointing can be reached after image {len(found.steps)}')
    if args.output:
        print_text(f'pointings written to {args.output}')
    return EXIT_ACCEPTED


def _pointings(path: Path) -> tuple[Pointing, ...]:
    """Return the rows of a file of pointings."""
    with errors_as(OptionError, path):
        rows = csv.DictReader(io.StringIO(read_text(path, PRODUCT_BYTES)))
    try:
        lacking = [name for name in _COLUMNS[:2] if name not in (rows.fieldnames or ())]
        if lacking:
            raise OptionError(f'{path}: no column {" and ".join(lacking)}')
        found = [Pointing(*(float(row.get(name) or 0.0) for name in _COLUMNS)) for row in rows]
    except (TypeError, ValueError, csv.Error) as error:
        raise OptionError(f'{path}: line {rows.line_num}: {error}') from error
    if not found:
        raise OptionError(f'{path}: no pointings')
    return tuple(found)


def _csv(found: Plan) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow([*_COLUMNS, 'stars', found.name])
    for step in found.steps:
        place = step.pointing
        angles = [f'{a:.4f}' for a in (place.ra_deg, place.dec_deg, place.roll_deg)]
        writer.writerow([*angles, step.stars, f'{step.sigma:.6g}'])
    return text.getvalue()


def _table(found: Plan) -> tuple[list[str], list[list[str]]]:
    header = ['image', 'ra', 'dec', 'roll', 'stars', found.name]
    rows = [['now', '', '', '', '', significant(found.sigma, 4)]]
    for k, step in enumerate(found.steps, 1):
        place = step.pointing
        angles = [f'{deg:.3f}' for deg in (place.ra_deg, place.dec_deg, place.roll_deg)]
        rows.append([str(k), *angles, str(step.stars), significant(step.sigma, 4)])
    return header, rows
