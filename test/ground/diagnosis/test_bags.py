# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The diagnosis of bags: the alignment that they show, and a process of its own for it."""

from __future__ import annotations

import dataclasses

from mission_files import images, TINY  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ground.diagnosis.attitude_readings import wire_attitudes
from starcal_ground.diagnosis.diagnose import Diagnosis, found_alignment
from starcal_ground.ros.setup_finder import Unmatched
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory


def test_two_images_are_too_few_for_an_alignment() -> None:
    two = Diagnosis('prior_alignment', [0.0, 0.0, 0.0, 1.0], 'x', images=2)
    assert found_alignment(two) == (None, '2 images agree, 3 are needed.')
    assert found_alignment(dataclasses.replace(two, images=3))[0] == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize('direction', ['st_to_inertial', 'inertial_to_st'])
def test_the_valid_attitudes_are_looked_at_as_they_were_received(direction) -> None:
    history = AttitudeHistory()
    assert wire_attitudes(history, direction).quaternion.shape == (0, 4)
    sent = {30: [0.6, 0, 0, 0.8], 20: [0, 0, 0, 0.5], 15: [np.nan] * 4, 10: [1.0, 0, 0, 0]}
    for time_ns, q in sent.items():
        history.add(time_ns, attitude_sample(time_ns, np.array(q), direction))
    kept = wire_attitudes(history, direction)
    assert kept.time_ns.tolist() == [10, 30]
    np.testing.assert_allclose(kept.quaternion, [sent[10], sent[30]], atol=1e-15)


@pytest.mark.slow
def test_a_process_of_its_own(tmp_path, monkeypatch) -> None:
    # In the folder of an untrusted bag: nothing that lies there is imported.
    (tmp_path / 'cv2.py').write_text('raise SystemExit(9)')
    monkeypatch.chdir(tmp_path)
    answers: list[Diagnosis] = []
    stated = {'camera_info_url': str(TINY / 'camera.yaml'), 'attitude_direction': 'inertial_to_st'}
    unmatched = Unmatched(load_setup(stated), AttitudeHistory(), answers.append)
    for image in images()[:3]:
        unmatched.add(image)
    assert unmatched._thread is not None
    unmatched._thread.join()
    assert [found.cause for found in answers] == ['no_attitude']
    assert answers[0].evidence[0].startswith('3 of 3 images identified without attitude')
    unmatched.close()
    unmatched.add(images()[0])
    unmatched._thread.join()
    assert len(answers) == 1
