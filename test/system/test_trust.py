# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The short form of ``bench trust``: where the world differs from the model, the sigma holds."""

from __future__ import annotations

import pytest

from bench import trust
from studies.rendered_worlds import World, world

ACCEPTED = (
    world('sound'),
    world('tilted detector', 1.0),
    world('ripple', 0.1),
    world('two lenses as ABBBA', 0.3),
    world('turning, unknown shutter', 0.1),
)
REFUSED = (world('two lenses as ABBBA', 1.0), world('aberration reversed', 0.5))


@pytest.mark.slow
@pytest.mark.parametrize('fault', ACCEPTED, ids=lambda fault: fault.name)
def test_an_accepted_camera_errs_by_less_than_two_sigma(fault: World) -> None:
    # `bench trust` finds 0.8 to 1.5 in these worlds, version 0.1.0 was at 7 to 45.
    outcome = trust.trial(fault, 1)
    assert outcome.accepted, outcome.reasons
    assert outcome.shape < 2.0


@pytest.mark.slow
@pytest.mark.parametrize('fault', REFUSED, ids=lambda fault: f'{fault.name} {fault.size:g}')
def test_a_fault_that_the_stars_show_is_refused_by_its_name(fault: World) -> None:
    outcome = trust.trial(fault, 1)
    assert not outcome.accepted
    assert any(cause in reason for cause in fault.causes for reason in outcome.reasons)
