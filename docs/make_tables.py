# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Write the tables of the documents from the code: ``python -m docs.make_tables [--check]``.

Parameters come from options dataclasses, refusal reasons and needed fields from records, export
formats and FITS keywords from their rows.  With --check nothing is written; the exit status is 1
if a table is out of date.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
import re
import sys
import textwrap
from typing import Any

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ground.fits_keywords import FACTS
from starcal_ground.mission.export.export_formats import FORMATS
from starcal_ros.pipeline.setup import (
    CalibratorOptions,
    NODE_OPTION_CLASSES,
    NodeOptions,
    ObserverOptions,
    OPTION_CLASSES,
)
from starcal_ros.record_fields import fields_of as fields_of_record
from starcal_ros.records import IMAGE_REFUSALS, STAR_REFUSALS, StarObservations
from tools.write_parameters import allowed, as_yaml, fields_of

DOCUMENTS = Path(__file__).parent


def parameter_table(*option_classes: type[Any], basic: bool = False) -> str:
    """Table of the basic or of the advanced parameters of option dataclasses."""
    rows = ['| parameter | default | allowed | description |', '|---|---|---|---|']
    for field in fields_of(option_classes, basic=basic):
        cells = (
            f'`{field.name}`',
            f'`{as_yaml(field.default)}`',
            allowed(field).removeprefix('; ').replace(' |', ','),
            field.metadata['description'],
        )
        rows.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(rows)


def reason_table(reasons: Mapping[str, str]) -> str:
    """Table of refusal reasons and their meanings."""
    rows = [f'| `{name}` | {meaning} |' for name, meaning in reasons.items()]
    return '\n'.join(['| reason | meaning |', '|---|---|', *rows])


def needed_fields() -> str:
    """Names of the fields that a message of observations needs: those without a default."""
    kinds = fields_of_record(StarObservations).values()
    needed = [f'`{kind.in_messages}`' for kind in kinds if not kind.has_default]
    return textwrap.fill(f'Needed are {", ".join(needed[:-1])} and {needed[-1]}.', 120)


def format_table() -> str:
    """Table of the export formats, their files, and what they leave out."""
    rows = [f'| `{row.name}` | {row.files} | {row.left_out} |' for row in FORMATS]
    return '\n'.join(['| `--to` | files | left out |', '|---|---|---|', *rows])


def fact_table() -> str:
    """Table of the facts that FITS headers state."""
    rows = ['| fact | keywords, of which the first counts | unit | check |', '|---|---|---|---|']
    for name, row in FACTS.items():
        keywords = ', '.join(f'`{key}`' for key in row.keywords)
        rows.append(f'| {name} | {keywords} | {row.unit or "text"} | {row.check} |')
    return '\n'.join(rows)


TABLES = {
    'nodes.md': {'needed fields of observations': needed_fields()},
    'parameters.md': {
        'basic parameters': parameter_table(*OPTION_CLASSES, *NODE_OPTION_CLASSES, basic=True),
        'parameters of both nodes and the tool': parameter_table(*OPTION_CLASSES, NodeOptions),
        'parameters of star_observer': parameter_table(ObserverOptions),
        'parameters of calibrator': parameter_table(CalibratorOptions),
        'parameters of bag_player': parameter_table(PlayerOptions),
    },
    'diagnostics.md': {
        'reasons to refuse an image': reason_table(IMAGE_REFUSALS),
        'reasons to leave out a star': reason_table(STAR_REFUSALS),
    },
    'mission_import.md': {'facts of FITS headers': fact_table()},
    'mission_export.md': {'export formats': format_table()},
}


def with_tables(document: str, text: str) -> str:
    """Return a document with the text between the marks of each table replaced."""
    for name, table in TABLES[document].items():
        marks = re.compile(f'(<!-- {name} -->\n).*?(<!-- end -->)', re.DOTALL)
        if len(marks.findall(text)) != 1:
            raise SystemExit(f'{document}: expected one table marked <!-- {name} -->')
        text = marks.sub(lambda found, table=table: found[1] + table + '\n' + found[2], text)  # type: ignore[misc]
    return text


def main() -> int:
    """Write the tables, or check that they are up to date."""
    parser = argparse.ArgumentParser(description='Write the tables of the documents.')
    parser.add_argument('--check', action='store_true', help='check only, write nothing')
    check = parser.parse_args().check
    for document in TABLES:
        file = DOCUMENTS / document
        before = file.read_text()
        after = with_tables(document, before)
        if check and after != before:
            print(f'{document} is out of date: run python -m docs.make_tables')
            return 1
        file.write_text(after)
    return 0


if __name__ == '__main__':
    sys.exit(main())
