# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The short form of ``bench trust``: where the world differs from the model, the sigma holds."""

from __future__ import annotations

import pytest

from bench import trust

ACCEPTED = (
    trust.world('sound'),
    trust.world('tilted detector', 1.0),
    trust.world('ripple', 0.1),
    trust.world('two lenses as ABBBA', 0.3),
)
REFUSED = (trust.world('two lenses as ABBBA', 1.0), trust.world('aberration reversed', 0.5))


@pytest.mark.slow
@pytest.mark.parametrize('world', ACCEPTED, ids=lambda world: world.name)
def test_an_accepted_camera_errs_by_less_than_two_sigma(world: trust.World) -> None:
    # `bench trust` finds 0.8 to 1.5 in these worlds, version 0.1.0 was at 7 to 45.
    outcome = trust.trial(world, 1)
    assert outcome.accepted, outcome.reasons
    assert outcome.shape < 2.0


@pytest.mark.slow
@pytest.mark.parametrize('world', REFUSED, ids=lambda world: f'{world.name} {world.size:g}')
def test_a_fault_that_the_stars_show_is_refused_by_its_name(world: trust.World) -> None:
    outcome = trust.trial(world, 1)
    assert not outcome.accepted
    assert any(cause in reason for cause in world.causes for reason in outcome.reasons)
