# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tables that the tool prints."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from sample_records import calibration, without_field  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from starcal_ground.cli.commands.calibrate import print_calibration
from starcal_ros.camera.projection import convert
from starcal_ros.records import FOUND, SigmaPart


def test_the_causes_that_matter_follow_the_result(capsys: pytest.CaptureFixture[str]) -> None:
    budget = (
        *calibration().sigma_budget,
        SigmaPart('stamps', 0.01, 0.02, '5 ms assumed'),
        SigmaPart('star tracker noise', 0.0, 12.0, 'estimated: 20, 20, 20″ about x, y, z'),
    )
    record = dataclasses.replace(calibration(), sigma_budget=budget)
    print_calibration(record, record.geometry)
    lines = capsys.readouterr().out.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith('1-sigma of lines'))
    assert [line.split('  ')[0] for line in lines[first + 1 : first + 4]] == [
        'total', 'star tracker noise', 'velocity'
    ]  # fmt: skip
    assert lines[first + 3].split() == ['velocity', '0.6″', '0.75″']
    assert 'stamps' not in '\n'.join(lines) and max(map(len, lines)) <= 80


def test_a_calibration_without_a_budget_has_no_table_of_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    record = dataclasses.replace(calibration(), sigma_budget=())
    print_calibration(record, record.geometry)
    assert '1-sigma of lines' not in capsys.readouterr().out


def test_an_alignment_that_the_images_gave_is_not_compared_with_itself(
    capsys: pytest.CaptureFixture[str],
) -> None:
    record = calibration()
    moved = record.geometry.star_tracker_from_camera * Rotation.from_rotvec([1e-4, 0.0, 0.0])
    prior = dataclasses.replace(record.geometry, star_tracker_from_camera_xyzw=moved.as_quat())
    rows = []
    for provenance in ({}, {FOUND: 'alignment'}):
        print_calibration(dataclasses.replace(record, provenance=provenance), prior)
        (row,) = re.findall('^alignment x .*$', capsys.readouterr().out, re.MULTILINE)
        rows.append(row.split())
    assert len(rows[0]) == 6 and rows[1] == rows[0][:4]


def test_a_lens_that_the_prior_did_not_have_has_no_changes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With ``lens_model: auto``."""
    prior = calibration().geometry
    camera, _ = convert(prior.camera, 'rational_polynomial')
    record = dataclasses.replace(
        without_field(),
        geometry=dataclasses.replace(prior, camera=camera),
        covariance=np.eye(len(camera.parameters) + 3),
    )
    print_calibration(record, prior)
    said = capsys.readouterr().out
    assert re.search(r'^k6 +\S+ +held, \S+ *$', said, re.MULTILINE)
    print_calibration(dataclasses.replace(record, parent_frame=''), prior)  # no alignment either
    assert 'from prior' in said and 'from prior' not in capsys.readouterr().out
