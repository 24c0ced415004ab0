# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Mistakes made on purpose are those that the diagnosis names."""

from __future__ import annotations

import json

import pytest
from tiny_campaign import image  # type: ignore[import-not-found]

from starcal_ground.simulation.simulated_bag import Mistakes, NO_MISTAKES
from starcal_ros.records import Image

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ('options', 'cause'),
    [
        (['--flip'], 'mirrored'),
        (['--rotate', '90'], 'rotated'),
        (['--attitude-direction', 'inertial_to_st'], 'attitude_direction'),
        (['--quaternion-order', 'wxyz'], 'quaternion_order'),
        (['--alignment-error', '10'], 'prior_alignment'),
        (['--focal-error', '20'], 'focal_length'),
        (['--clock-error', '8'], 'clock'),
        (['--smear', '12'], 'smear'),
        (['--gamma', '2.2'], 'not_linear'),
    ],
)
def test_each_is_named(options, cause, tmp_path, starcal) -> None:
    bag = tmp_path / 'bag'
    made = starcal('simulate', '-o', bag, '--scenario', 'tiny', '--images', 3, *options)
    assert made.status == 0 and 'truth.json' in made.out and 'params.yaml' in made.out
    assert json.loads((bag / 'truth.json').read_text())['images'] == 3
    status, out, _ = starcal('diagnose', bag, '--params', bag / 'params.yaml', '--json')
    found = json.loads(out)
    assert (found['cause'], found['also']) == (cause, [])
    assert status == 3


def test_none_changes_nothing() -> None:
    shown: Image = image()
    same = NO_MISTAKES.image(shown)
    assert same.time_ns == shown.time_ns and (same.pixels == shown.pixels).all()
    late = Mistakes(clock_error_s=2.5).image(shown)
    assert late.time_ns - shown.time_ns == 2_500_000_000
