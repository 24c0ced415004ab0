# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The estimator in simulated worlds: exact, true to its sigma, and robust."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds import campaign, each_image, errors_of, estimate_of, normalised_error  # type: ignore[import-not-found]

from bench.evidence import simulated
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from studies.worlds import Campaign, simulate, World, WORLDS

SEEDS = range(1, 21)


def estimated(made: Campaign, **options: object) -> Estimate:
    return estimate_of(made, **{'velocity_sigma_m_s': 0.0, **options})  # type: ignore[no-any-return]


def per_number(found: Estimate, truth: CameraGeometry, rows: slice) -> float:
    """Squared error in the metric of the reported covariance, per number."""
    return float(normalised_error(found, truth, rows) / (rows.stop - rows.start))


def sound(seed: int) -> Campaign:
    """Six images of 500 stars."""
    made: Campaign = campaign(World(images=6), seed)
    return made


@pytest.mark.slow
def test_normalised_errors_are_chi_squared() -> None:
    found = [estimated(sound(seed)) for seed in SEEDS]
    truths = [sound(seed).scenario.truth for seed in SEEDS]
    camera = list(map(per_number, found, truths, [slice(0, 10)] * len(found)))
    low, high = chi2.ppf([0.0005, 0.9995], 10 * len(SEEDS)) / (10 * len(SEEDS))
    # A field of unknown size widens the sigma of a lens without one, by a tenth.
    assert 0.85 * low < np.mean(camera) < high
    assert max(camera) < chi2.isf(1e-5, 10) / 10
    pointing = list(map(per_number, found, truths, [slice(10, 13)] * len(found)))
    # Slow errors as large as the noise are part of it until the images show otherwise.
    assert 0.15 < np.mean(pointing) < chi2.isf(0.001, 60) / 60
    assert {one.termination for one in found} == {'converged'}
    assert not any(one.misfit_image.any() for one in found)
    # One in 25,000 sound stars is beyond 4.5 sigma.
    assert sum(int((~one.kept).sum()) for one in found) < 15
    ratios = []
    for one in found:
        covariance_px2 = one.table.covariance_px2
        scaled_px2 = one.weights.variance.of(covariance_px2, one.table.magnitude)
        ratios.append(scaled_px2[:, 0] / covariance_px2[:, 0])
    assert np.mean(np.concatenate(ratios)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ('method', 'estimate'),
    [
        ('hierarchical', ('fx', 'fy')),
        ('single', ('fx', 'skew', 'fy', 'cx', 'cy', 'k1')),
        ('per_image', ('distortion',)),
    ],
)
def test_held_parameters_keep_their_prior_to_the_last_bit(method, estimate) -> None:
    made = sound(2)
    names = made.scenario.prior.camera.parameter_names
    asked = {*estimate, *(names[5:] if 'distortion' in estimate else ())}
    found = estimated(made, method=method, estimate=estimate)
    held = [k for k, name in enumerate(names) if name not in asked]
    free = [k for k, name in enumerate(names) if name in asked]
    before, after = made.scenario.prior.camera.parameters, found.geometry.camera.parameters
    assert before[held].tobytes() == after[held].tobytes()
    assert (before[free] != after[free]).all()
    assert not found.covariance[held].any() and not found.covariance[:, held].any()
    assert (np.diag(found.covariance)[free] > 0).all()


def test_a_held_parameter_with_a_sigma_is_a_consider_parameter() -> None:
    made = sound(3)  # no field takes a part of the change, as of seed 2
    names = made.scenario.prior.camera.parameter_names
    k = names.index('k1')
    sigma = np.zeros(len(names))
    asked = tuple(name for name in names if name != 'k1')
    exactly = estimated(made, estimate=asked)
    sigma[k] = 1e-2
    considered = estimated(made, estimate=asked, prior_sigma=tuple(sigma.tolist()))
    assert considered.geometry.camera.parameters[k] == made.scenario.prior.camera.parameters[k]
    assert considered.covariance[k, k] == pytest.approx(1e-4)
    # Its effect on the others is that of a change of it by its sigma.
    prior = made.scenario.prior
    k1 = float(prior.camera.parameters[k] + 1e-2)
    moved = dataclasses.replace(prior, camera=prior.camera.replace(k1=k1))
    scenario = dataclasses.replace(made.scenario, prior=moved)
    other = estimated(dataclasses.replace(made, scenario=scenario), estimate=asked)
    change = other.geometry.camera.parameters - exactly.geometry.camera.parameters
    added = np.diag(considered.covariance - exactly.covariance)[:10]
    near = np.abs(change[:5]) > 3 * np.sqrt(np.diag(exactly.covariance)[:5])
    assert near.any()
    assert np.sqrt(added[:5][near]) == pytest.approx(np.abs(change[:5][near]), rel=0.1)


# Limits of the error over the reported sigma, rms of two seeds, for shape and pointing.
DEPARTURES = {
    'n3': (2.0, 2.0),
    'vel_leo_ram': (2.0, 2.0),
    'rip7_010': (1.8, 1.8),
    'n6_walk': (1.8, 2.0),
    'breath6': (1.8, 1.8),
    'catalog03_bright24': (1.8, 1.8),
}


@pytest.mark.slow
@pytest.mark.parametrize('name', DEPARTURES)
def test_departures_are_in_the_sigma(name: str) -> None:
    scores = [simulated(WORLDS[name], seed) for seed in (1, 2)]
    off = np.sqrt(np.mean([(s.shape**2, s.pointing**2) for s in scores], axis=0))
    assert (off < DEPARTURES[name]).all()


def test_outliers_and_bad_stars_are_left_out() -> None:
    made = simulate(dataclasses.replace(WORLDS['out5'], images=8), 1)
    found = estimated(made)
    # Displacements of 1 to 20 px of one star in twenty; those of under 4.5 sigma stay.
    assert 0.03 < (~found.kept).mean() < 0.06
    assert per_number(found, made.scenario.truth, slice(0, 10)) < chi2.isf(1e-4, 10) / 10
    assert 5 <= len(estimated(simulate(WORLDS['badstars'], 1)).dropped_catalog_id) <= 10


def test_an_image_with_a_wrong_attitude_is_a_misfit_and_moves_nothing() -> None:
    made, turn = sound(4), Rotation.from_rotvec([0.0, 600.0 * ARCSECOND_RAD, 0.0])

    def turned(k: int, image: StarObservations) -> dict[str, object]:
        reported = Rotation.from_quat(image.icrf_from_star_tracker_xyzw)
        return {'icrf_from_star_tracker_xyzw': (reported * turn).as_quat()} if k == 2 else {}

    wrong = dataclasses.replace(made, ensemble=each_image(made.ensemble, turned))
    found = estimated(wrong)
    assert np.flatnonzero(found.misfit_image).tolist() == [2]
    assert per_number(found, made.scenario.truth, slice(10, 13)) < chi2.isf(0.001, 3) / 3
    assert per_number(found, made.scenario.truth, slice(0, 10)) < chi2.isf(0.001, 10) / 10
    assert found.kept[found.table.image == 2].all()  # its stars still count


@pytest.mark.parametrize(('images', 'flexing'), [(6, 2e-3), (18, 5e-4)])
def test_the_sigma_of_a_lens_that_sags_covers_each_of_its_shapes(images, flexing) -> None:
    made = simulate(World(images=images, flexing=flexing), 1)
    found = estimated(made)
    assert found.termination == 'converged' and found.kept.mean() > 0.99
    # p1 of the second half of the images is larger than that of the first.
    p1 = made.scenario.truth.camera.parameter_names.index('p1')
    off = errors_of(found, made.scenario.truth)[p1] + flexing * np.array([-0.5, 0.5])
    assert np.abs(off).max() < 2.0 * np.sqrt(found.covariance[p1, p1])
    shown = found.posterior.of_images[:, found.linear.layout.places['shape']]
    assert np.ptp(shown, axis=0).argmax() == 3


@pytest.mark.parametrize(('seed', 'stated_arcsec'), [(1, 0.1), (2, 2.0), (3, 0.1)])
def test_a_stated_sigma_that_is_far_too_small_bends_nothing(seed, stated_arcsec) -> None:
    made = sound(seed)  # of 20 arcsec
    found = estimated(made, star_tracker_sigma_arcsec=(stated_arcsec,) * 3)
    assert found.termination == 'converged' and not found.misfit_image.any()
    assert per_number(found, made.scenario.truth, slice(10, 13)) < chi2.isf(0.01, 3) / 3
    assert per_number(found, made.scenario.truth, slice(0, 10)) < chi2.isf(0.001, 10) / 10
    # Six images hardly tell noise from slow errors.
    tracker = found.attitudes.trackers[0]
    assert 10.0 < stated_arcsec * np.hypot(tracker.noise, tracker.slow) < 60.0


def test_the_order_of_images_and_the_length_of_the_list_change_nothing() -> None:
    made = sound(5)
    turned = dataclasses.replace(made, ensemble=Ensemble(made.ensemble.images[::-1]))
    one, other = (estimated(each) for each in (made, turned))
    off = one.geometry.camera.parameters - other.geometry.camera.parameters
    off /= np.sqrt(np.diag(one.covariance)[:10])
    # Rounds stop at a step of a twentieth of a sigma.
    assert np.abs(off).max() < 0.02
