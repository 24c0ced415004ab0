# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Codes of star refusals, and their names in messages and files."""

from __future__ import annotations

import numpy as np

from starcal_ros.records import (
    Ensemble,
    refused_image,
    STAR_REFUSALS,
    StarObservations,
    StarRefusal,
)


def test_codes_fit_their_arrays() -> None:
    """Zero is a star that is used, so that an array of zeros refuses none."""
    assert not StarRefusal.NONE.value and StarRefusal.NONE.label not in STAR_REFUSALS
    np.testing.assert_array_equal(np.array(list(StarRefusal), np.uint8), list(StarRefusal))


def test_names_ascend_with_their_codes() -> None:
    """Messages list the names in order of the codes: as sorted, which is how 0.1 wrote them."""
    assert list(STAR_REFUSALS) == sorted(STAR_REFUSALS)


def test_an_image_is_used_until_it_is_refused() -> None:
    used = StarObservations.of_image(5, (640, 512), noise_dn=2.0)
    assert (used.time_ns, used.width, used.height, used.noise_dn) == (5, 640, 512, 2.0)
    assert used.refusal == used.detail == '' and len(used) == 0
    refused = refused_image(5, 640, 512, 'no_match', 'three stars')
    assert (refused.refusal, refused.detail) == ('no_match', 'three stars')
    assert Ensemble().add(used).images and not Ensemble().add(refused).images
