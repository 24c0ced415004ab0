# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The paper's night: frames as any image, judging by images not seen, the page."""

import dataclasses
import itertools
import json
from pathlib import Path
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from sample_sky import errors_sigma  # type: ignore[import-not-found]

from starcal_ground.simulation import centroids as simulated_centroids
from starcal_ground.simulation import scenario
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.records import Ensemble
from studies import __main__ as studies
from studies import monte_carlo, paper
from studies.paper import judge, PaperStudy, spread

pytestmark = pytest.mark.slow

NIGHT = scenario.scenario(paper.NIGHT, seed=3)


@pytest.fixture(scope='module')
def ensemble() -> Ensemble:
    """Observations of eighteen frames of the night, without pixels."""
    few = dataclasses.replace(NIGHT, cadence_s=200.0, image_count=18)
    return simulated_centroids.true_observations(few)


@pytest.fixture(scope='module')
def found(ensemble: Ensemble) -> PaperStudy:
    design = monte_carlo.Design('table1', 2, (15,), (20,), (0.0, 20.0), ('per_image', 'single'))
    rows = itertools.chain(*(monte_carlo.run_trial(design, k) for k in range(design.trials)))
    table1 = monte_carlo.conclude(design, rows)
    return paper.study(ensemble.images, table1, seed=3)


def test_a_frame_is_measured_in_its_pixels() -> None:
    observed = paper.observe_frame(3, 100)
    assert observed.refusal == '' and len(observed) > 200
    off = errors_sigma(scenario.scene(NIGHT, 100), observed)
    # Of five hundred numbers of unit variance, the spread is known to 3 %.
    assert np.median(np.abs(off)) == pytest.approx(0.674, abs=0.1)


def test_the_true_camera_leaves_the_noise(ensemble: Ensemble) -> None:
    judged = judge(NIGHT.truth.camera, ensemble.images, 4.5)
    sigma2 = np.concatenate([i.covariance_px2[:, [0, 2]] for i in ensemble.images])
    # 10^4 numbers; the rotation of an image takes three of its 600 degrees of freedom.
    rms_px = judged.rms_px(range(len(ensemble.images)))
    assert rms_px == pytest.approx(np.sqrt(sigma2.mean()), rel=0.03)
    assert judged.fits.mean() > 0.999  # 4.5 sigma: 4 in 10^5
    wrong = judge(NIGHT.prior.camera, ensemble.images, 1e9)
    assert wrong.rms_px([0]) > 2 * judged.rms_px([0])


def test_images_are_spread_over_the_night() -> None:
    assert spread(3, 359) == (0, 179, 358)
    assert len(spread(15, 359)) == 15
    assert spread(15, 4) == (0, 1, 2, 3)


def test_the_study_shows_what_the_paper_concludes(found: PaperStudy) -> None:
    assert len(found.used) == 15
    rows = {str(row['method']): row for row in found.methods}
    # Three images of 300 stars that were not used: 2.4 % is the 1-sigma of such a ratio.
    assert float(rows['per_image']['others_px']) == pytest.approx(found.noise_rms_px, rel=0.02)
    assert float(rows['single']['map_error_px']) > 2 * float(rows['per_image']['map_error_px'])
    gone = [removal.removed for removal in found.removals[1:]]
    assert sorted(gone) == sorted(PARAMETER_NAMES)
    assert {'cx', 'cy', 'k3'} <= set(gone[:4]) and 'skew' in gone[:6]
    assert not {'k1', 'fx', 'fy'} & set(gone[:5]) and gone[-1] in ('fx', 'fy', 'k1')
    # (paper: only 5-6 of the ten matter)
    residual_px = [removal.residual_rms_px for removal in found.removals]
    assert residual_px[4] < 1.01 * residual_px[0] and residual_px[-1] > 1.2 * residual_px[0]
    assert all(later > 0.999 * sooner for sooner, later in itertools.pairwise(residual_px))
    changes_px = [removal.map_change_px for removal in found.removals]
    assert changes_px[0] < 1e-6 and changes_px[3] < 0.02 < changes_px[-1]


def test_one_command_makes_it_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command as it is, with a worker of its own, on the first four frames of the night."""
    short = dataclasses.replace(paper.TABLE_1, stars=(20,), tracker_arcsec=(20.0,))
    night = dataclasses.replace(NIGHT, image_count=4)
    monkeypatch.setattr(paper, 'TABLE_1', short)
    monkeypatch.setattr(paper, 'CALIBRATED_WITH', 3)
    monkeypatch.setattr(studies, 'scenario', lambda *_: night)  # what counts the frames
    arguments = ['paper', '--trials', '1', '--seed', '3', '--workers', '1']
    assert studies.main([*arguments, '-o', str(tmp_path)]) == 0
    numbers = json.loads((tmp_path / 'paper.json').read_text())
    assert (numbers['images'], numbers['used'], numbers['others']) == (4, 3, 1)
    text = (tmp_path / 'paper.md').read_text()
    linked = {tmp_path / name for name in re.findall(r'\((images/paper_\w+\.svg)\)', text)}
    assert 'nan' not in text and linked == {*(tmp_path / 'images').iterdir()}
    for drawn in (figure.read_text() for figure in linked):
        assert ElementTree.fromstring(drawn).tag.endswith('svg') and 'nan' not in drawn
