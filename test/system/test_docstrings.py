# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each public function, and each record that a user holds, has an example that runs."""

from __future__ import annotations

import dataclasses
import doctest
from pathlib import Path
import shutil
import sys
import typing

import pytest

import starcal_ground
from starcal_ground.comparison import Comparison
import starcal_ros
from starcal_ros.records import Calibration, Ensemble, MapCovariance

PUBLIC = [
    getattr(package, name)
    for package in (starcal_ros, starcal_ground)
    for name in package.__all__
    if name != '__version__'
]
# Shown in the example of the record that holds them.
LEAVES = {'Amplitude', 'ChiSquared', 'DetectorStep', 'DifferenceMap', 'ResidualBin'}


def records_in(kind: object) -> set[type]:
    """The records in a type: itself, and those of its fields."""
    inside = {record for part in typing.get_args(kind) for record in records_in(part)}
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind).values()
        return {kind, *inside}.union(*(records_in(hint) for hint in hints))
    return inside


HELD = {
    record for kind in (Calibration, Comparison, Ensemble, MapCovariance)
    for record in records_in(kind) if record.__name__ not in LEAVES
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    'described',
    [*PUBLIC, *sorted(HELD - {*PUBLIC}, key=lambda kind: kind.__name__)],
    ids=lambda described: described.__name__,
)
def test_the_example_of_a_docstring_runs(described, tiny_products, tmp_path, monkeypatch) -> None:
    shutil.copytree(tiny_products, tmp_path / 'out')
    (tmp_path / 'bags').symlink_to(Path(__file__).parents[2] / 'bags')
    monkeypatch.chdir(tmp_path)
    names = vars(sys.modules[described.__module__]).copy()
    (example,) = doctest.DocTestFinder(recurse=False).find(described, globs=names)
    assert example.examples
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert ''.join(said) == ''
