# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images without a match, measured again with the calibration of the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from starcal_ros.pipeline import solve, topics
from starcal_ros.pipeline.retry import measured_again
from starcal_ros.pipeline.setup import read_setup
from starcal_ros.records import Ensemble, refused_image

TINY = Path(__file__).parents[2] / 'bags' / 'tiny'


def test_an_image_without_a_match_is_measured_with_the_calibration() -> None:
    setup = read_setup(TINY / 'params.yaml')
    chosen = topics.choose_topics([TINY], topics.Topics(), setup)
    seen = list(topics.read([TINY], chosen, setup))
    width, height = seen[0].width, seen[0].height
    lost = refused_image(seen[2].time_ns, width, height, 'no_match', 'lost')
    smeared = refused_image(seen[5].time_ns, width, height, 'no_stars', 'smeared')
    before = [*seen[:2], lost, *seen[3:5], smeared, *seen[6:]]
    ensemble = Ensemble()
    for record in before:
        ensemble = solve.add_to_ensemble(ensemble, record, setup)
    geometry = solve.solve(ensemble, setup).geometry
    again = measured_again([TINY], chosen, setup, geometry, before)
    assert [record.refusal for record in again] == [''] * 5 + ['no_stars'] + [''] * 4
    assert all(a is b for k, (a, b) in enumerate(zip(again, before, strict=True)) if k != 2)
    # The same stars at the same places, by a search in place of a track.
    common = np.isin(again[2].catalog_id, seen[2].catalog_id)
    assert common.sum() > 0.95 * len(seen[2])
