# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`make check` runs the tests that are nearest to what changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.tests_of_change import nearest_tests

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ('changed', 'nearest'),
    [
        ('starcal_ros/estimation/weights.py', 'test/onboard/estimation/test_weights.py'),
        ('starcal_ros/errors.py', 'test/onboard/test_errors.py'),  # imported by 69 test files
        # Imported by no test, but by the package that the tests import.
        ('starcal_ros/records/calibration.py', 'test/onboard/records/test_observations.py'),
        (
            'starcal_ground/cli/commands/plan.py',
            'test/ground/cli/commands/test_plan.py',
        ),  # loaded by name
        ('test/flight.py', 'test/nodes/test_hostile_messages.py'),  # a helper of tests
        ('test/onboard/test_text.py', 'test/onboard/test_text.py'),
    ],
)
def test_the_tests_of_a_changed_file_are_few_and_about_it(changed, nearest, monkeypatch):
    monkeypatch.chdir(ROOT)
    tests = nearest_tests([Path(changed)])
    assert Path(nearest) in tests
    assert len(tests) < 20, tests  # of more than 200 files


def test_documents_and_files_that_are_gone_have_no_tests(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert nearest_tests([Path('README.md'), Path('test/test_gone.py')]) == []
