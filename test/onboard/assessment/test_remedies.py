# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The one table of remedies: each name is given by something, each option in a text exists."""

from __future__ import annotations

from pathlib import Path
import re

import pytest

import starcal_ros
from starcal_ros.assessment.remedies import REMEDIES
from starcal_ros.estimation.unknowns import UNKNOWNS
from starcal_ros.options import names_of
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES
from starcal_ros.records import IMAGE_REFUSALS

OPTIONS = names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
ROOT = Path(starcal_ros.__file__).parents[1]
SOURCE = '\n'.join(
    path.read_text().partition('\nREMEDIES: ')[0]
    for package in ('starcal_ros', 'starcal_ground')
    for path in (ROOT / package).rglob('*.py')
)
OF_UNKNOWNS = [kind.remedy for kind in UNKNOWNS.values() if kind.remedy]
OF_PRIORS = [kind.tested.remedy for kind in UNKNOWNS.values() if kind.tested is not None]


@pytest.mark.parametrize('name', REMEDIES)
def test_each_name_is_a_refusal_a_check_or_a_cause(name: str) -> None:
    is_written = f"'{name}'" in SOURCE or f'"{name}"' in SOURCE
    assert name in {*IMAGE_REFUSALS, *OPTIONS} or is_written


@pytest.mark.parametrize('text', [*REMEDIES.values(), *OF_UNKNOWNS, *OF_PRIORS])
def test_the_options_of_a_remedy_exist(text: str) -> None:
    assert set(re.findall(r'\b[a-z]\w*_\w+', text)) <= OPTIONS | {'setup_finder'}


def test_no_other_module_has_a_table_of_remedies() -> None:
    assert not re.findall(r'^_?(?:REMED|MEASURES)\w* = \{', SOURCE, re.MULTILINE)
