# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""From an ensemble to a calibration: the smallest lens model, statistics, verdict; refusals."""

import dataclasses
import hashlib
import json
from pathlib import Path

from geometries import turn_between  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_campaign import ensemble, image, TRUTH, values  # type: ignore[import-not-found]
from worlds import each_image, honesty, observed, of_random_pointings  # type: ignore[import-not-found]

from starcal_ground.bags.reader import read_observations
from starcal_ground.campaign import ensemble_of
from starcal_ground.parameter_files import NODES, read_parameter_file
from starcal_ground.products import inputs_of
from starcal_ground.residuals import solve_with_residuals
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.camera.projection import convert
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.identification.star_finder import realigned
from starcal_ros.options import names_of
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import load_setup, OPTION_CLASSES, Setup, with_method
from starcal_ros.pipeline.solve import provenance_of
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    Calibration,
    Ensemble,
    refused_image,
    StarObservations,
)


@pytest.fixture(scope='module')
def setup(camera_yaml: Path) -> Setup:
    return load_setup(values(camera_yaml))


def test_refused_images_are_counted(setup: Setup) -> None:
    collected, late = Ensemble(), refused_image(image().time_ns, 640, 512, 'out_of_order', '')
    first, second, *_ = ensemble().images
    for observations in (first, late, second, late):
        collected = solve.add_to_ensemble(collected, observations, setup)
    assert collected.images == ensemble().images[:2]
    assert collected.refused == {'out_of_order': 2}
    status = solve.ensemble_status(collected, setup)
    assert (status.images, status.refused) == (2, {'out_of_order': 2})


def test_a_constellation_that_no_camera_shows_is_counted(setup: Setup) -> None:
    """Negated, mirrored or mixed-up directions have unit length: only their places show them."""
    sound = ensemble().images[0]
    mixed = np.random.default_rng(1).permutation(len(sound))
    for directions in (
        -sound.direction_icrf,
        sound.direction_icrf * [1, 1, -1],
        sound.direction_icrf[mixed],
    ):
        wrong = dataclasses.replace(sound, direction_icrf=directions)
        collected = solve.add_to_ensemble(Ensemble(), wrong, setup)
        assert (collected.images, collected.refused) == ((), {'bad_observations': 1})


def test_at_the_limit_an_image_goes_for_each_that_comes(camera_yaml: Path) -> None:
    limited = load_setup(values(camera_yaml, max_images=4))
    collected = Ensemble()
    for observations in ensemble().images:
        collected = solve.add_to_ensemble(collected, observations, limited)
    stars = sorted(len(i) for i in ensemble().images)
    for kept in (collected, ensemble_of(ensemble().images, limited)):
        assert len(kept.images) == 4
        assert min(len(i) for i in kept.images) > stars[2]


@pytest.fixture(scope='module')
def found(setup: Setup) -> Calibration:
    """Calibration of the small campaign."""
    return solve.solve(ensemble(), setup)


def test_a_solution_with_its_statistics(found: Calibration) -> None:
    assert found.accepted and found.reasons == ()
    assert found.termination == 'converged'
    assert found.method == CalibrationOptions().method
    assert found.estimated == estimated_parameters(CalibrationOptions(), 'plumb_bob')
    assert found.images_used == 10 and found.stars_rejected <= 4
    assert found.stars_used + found.stars_rejected == ensemble().star_count
    assert found.time_ns == ensemble().images[-1].time_ns
    assert found.variance_factor == pytest.approx(1.0, abs=0.1)
    assert (found.parent_frame, found.child_frame) == ('star_tracker', 'camera_optical_frame')
    # Skew of 0.1 px or so, sheared over half the height.
    assert 0 < found.zero_skew_cost_px < 0.2
    error = found.geometry.camera.parameters - TRUTH.camera.parameters
    free = [PARAMETER_NAMES.index(name) for name in found.estimated]
    assert np.abs(error[free] / found.sigma[free]).max() < 5
    # Ten images of 10, 10 and 40 arcsec: 13 in the mean, and 36 of the principal point, whose 0.3
    # px the alignment takes up.
    assert turn_between(found.geometry, TRUTH).magnitude() / ARCSECOND_RAD < 50
    own = [realigned(found.geometry, one).star_tracker_from_camera for one in ensemble().images]
    apart_rad = (Rotation.concatenate(own).mean().inv() * Rotation.concatenate(own)).as_rotvec()
    scatter_arcsec = np.sqrt(apart_rad.var(axis=0).mean()) / ARCSECOND_RAD
    # That of the estimate weighs stars by their covariances: 32.2 for 32.5.
    assert found.alignment_scatter_arcsec == pytest.approx(scatter_arcsec, rel=0.03)


def test_lateral_colour_is_estimated(setup: Setup, found: Calibration) -> None:
    plain, per_mag, mean = found, 5e-4, 0.65  # 0.2 px a magnitude in a corner; mean of the stars

    def moved(_: int, one: StarObservations) -> dict[str, object]:
        colour = np.nan_to_num(setup.catalog.colours_bp_rp(one.catalog_id) - mean)
        from_axis = one.measured_px - TRUTH.camera.parameters[3:5]
        return {'measured_px': one.measured_px + per_mag * colour[:, None] * from_axis}

    found = solve.solve(each_image(ensemble(), moved), setup)
    assert found.accepted
    (part,) = (part for part in found.sigma_budget if part.cause == 'lateral colour')
    # Thousands of stars of 0.17 px, and a few of 0.001 px, show it to 1e-5.
    assert float(part.assumption.split()[1]) == pytest.approx(1e6 * per_mag, abs=40.0)
    # Without it the residuals grow by a tenth, a change from image to image of 0.1 px seems to
    # be there, and the 1-sigma of the map is seven times as large.  With it one of 0.03 px is
    # still likelier than none by e^2.7, which is 1.7 times the sigma.
    assert found.residual_rms_px == pytest.approx(plain.residual_rms_px, rel=0.01)
    assert found.sigma_budget[0].map_arcsec < 1.8 * plain.sigma_budget[0].map_arcsec


def test_a_solution_is_mapped_over_the_detector(setup: Setup) -> None:
    # With the principal point held: one that is estimated trades with pitch and yaw.
    found = solve.solve(ensemble(), with_method(setup, '', ('fx', 'skew', 'fy', 'distortion')))
    maps, correlation = found.maps, found.correlation
    assert maps is not None and correlation is not None
    assert maps.stars.shape == (8, 10) and maps.stars.sum() == found.stars_used
    # Stars left out as outliers cover nothing.
    covered = next(check for check in found.gate if check.option == 'min_coverage')
    assert covered.found == (maps.stars > 0).mean()
    whole, shape = maps.line_of_sight_sigma_arcsec, maps.shape_sigma_arcsec
    assert whole.shape == shape.shape == (16, 20)
    # The centre is as good as the alignment: pitch and yaw of the 13 x 13 covariance; the two
    # middle rows and columns are half a cell off it.
    pitch_yaw_arcsec = np.hypot(*found.sigma[10:12]) / ARCSECOND_RAD
    np.testing.assert_allclose(whole[7:9, 9:11], pitch_yaw_arcsec, rtol=0.05)
    assert (shape < whole).all() and whole.argmin() not in (0, 19, 300, 319)
    assert correlation.names == (*found.estimated, *ALIGNMENT_NAMES)
    np.testing.assert_allclose(np.diag(correlation.matrix), 1.0, rtol=1e-12)
    rows = [found.parameter_names.index(name) for name in correlation.names]
    np.testing.assert_allclose(
        correlation.matrix * np.outer(found.sigma[rows], found.sigma[rows]),
        found.covariance[np.ix_(rows, rows)],
        rtol=1e-9,
    )


@pytest.mark.slow
def test_method_and_names_can_be_said_for_one_solution(setup: Setup) -> None:
    found = solve.solve(ensemble(), with_method(setup, 'single', ['fx', 'fy', 'k1']))
    assert (found.method, found.estimated) == ('single', ('fx', 'fy', 'k1'))
    prior, after = setup.prior.camera.parameters, found.geometry.camera.parameters
    changed = [n for n, a, b in zip(PARAMETER_NAMES, prior, after, strict=True) if a != b]
    assert changed == ['fx', 'fy', 'k1']
    options = json.loads(found.provenance['options'])
    assert options['method'] == 'single' and options['estimate'] == ['fx', 'fy', 'k1']
    assert setup.calibration.method == CalibrationOptions().method
    with pytest.raises(OptionError, match="method: 'best' is not one of"):
        with_method(setup, 'best', [])
    with pytest.raises(OptionError, match=r"estimate\[0\]: 'fz' is not one of fx, skew"):
        with_method(setup, '', ['fz'])


@pytest.mark.slow
def test_images_with_temperatures_give_a_calibration_with_terms(camera_yaml: Path) -> None:
    """The simulated camera does not change with temperature, and that is what is found."""
    warm = load_setup(values(camera_yaml, focal_temperature_order=1, alignment_temperature=True))
    images = Ensemble(ensemble().images[:4])
    measured = each_image(images, lambda k, _: {'temperature_degc': 10.0 + 5.0 * k})
    terms = solve.solve(measured, warm).temperature
    assert terms is not None and (terms.reference_degc, terms.note) == (20.0, '')
    for name in ('focal_per_degc', 'alignment_rate_rad_per_degc'):
        estimated, sigma = getattr(terms, name), getattr(terms, f'{name}_sigma')
        assert estimated and (np.abs(estimated) < 4 * np.array(sigma)).all()
    terms = solve.solve(images, warm).temperature
    assert terms is not None and terms.note == 'left out: 4 of 4 images have no temperature'


@pytest.mark.slow
def test_provenance_tells_all_that_went_in_and_gives_equal_numbers(setup, found) -> None:
    first = found.provenance
    assert first['software'].startswith('starcal ')
    assert first['catalog'] == setup.catalog.digest
    prior = json.loads(first['prior'])
    assert prior[:10] == setup.prior.camera.parameters.tolist()
    assert prior[10:] == setup.prior.star_tracker_from_camera_xyzw.tolist()
    # From the options in it the setup can be made again.
    options = json.loads(first['options'])
    assert set(options) == names_of(*OPTION_CLASSES)
    again = load_setup(options)
    second, _ = solve_with_residuals(ensemble(), again, {'bag': 'abc'})
    assert second.provenance == {**first, 'input bag': 'abc'}
    np.testing.assert_array_equal(second.covariance, found.covariance)
    camera, of_first = second.geometry.camera, found.geometry.camera
    np.testing.assert_array_equal(camera.parameters, of_first.parameters)
    assert first['observations_sha256'] == provenance_of(setup, ensemble())['observations_sha256']


def test_the_digest_is_of_all_that_a_calibration_is_made_from(setup: Setup) -> None:
    def digest_of(*images: StarObservations) -> str:
        return provenance_of(setup, Ensemble(images))['observations_sha256']

    first, *others = ensemble().images
    digest = digest_of(first, *others)
    assert digest_of(*others, first) != digest
    for changed in (
        {'time_ns': first.time_ns + 1},
        {'icrf_from_star_tracker_xyzw': np.roll(first.icrf_from_star_tracker_xyzw, 1)},
        {'direction_icrf': -first.direction_icrf},
        {'measured_px': np.nextafter(first.measured_px, np.inf)},
        {'covariance_px2': 2.0 * first.covariance_px2},
        {'catalog_id': first.catalog_id + 1},
        {'temperature_degc': 20.0},
    ):
        assert digest_of(dataclasses.replace(first, **changed), *others) != digest
    assert digest_of(dataclasses.replace(first, psf_sigma_px=3.0), *others) == digest


def test_digests_can_be_stopped(tmp_path: Path) -> None:
    """A file of three blocks, stopped after the first."""
    file = tmp_path / 'bag'
    file.write_bytes(bytes(3 << 20))
    asked = iter([False, True])
    stopped = inputs_of([file], lambda: next(asked))
    assert stopped[str(file)] == f'sha256:{hashlib.sha256(bytes(1 << 20)).hexdigest()}'
    assert inputs_of([file])[str(file)] == f'sha256:{hashlib.sha256(bytes(3 << 20)).hexdigest()}'


KB97 = Path(__file__).parents[4] / 'shared/realsky/lco_kb97_observations'


@pytest.mark.slow
def test_a_lens_that_the_stars_do_not_show_loses_without_a_traceback() -> None:
    if not KB97.is_dir():
        pytest.skip('lco_kb97_observations is not on this machine')
    stated = read_parameter_file(KB97 / 'params.yaml', NODES)
    stated |= {name: str(KB97 / str(stated[name])) for name in ('camera_info_url', 'catalog')}
    setup = load_setup(stated)
    ensemble = Ensemble()
    for record in read_observations([KB97 / 'observations.mcap'], '/observations'):
        ensemble = ensemble.add(record)
    found = solve.estimate_with_smallest_lens(ensemble, setup.prior, setup.calibration)
    camera = found.geometry.camera
    assert camera.intrinsics[0] == pytest.approx(180540.9, rel=0.01)
    # In half a degree the stars show no other coefficients: k4 was -7e14 in an equidistant.
    assert camera.model == setup.prior.camera.model


@pytest.mark.slow
def test_no_camera_fits_mirrored_noise() -> None:
    """The fit ends at fx or fy below zero, where there is no camera, or it does not end."""
    (given, ensemble), middle = observed(1, images=6), (648.0, 512.0)
    options = CalibrationOptions(
        star_tracker_sigma_arcsec=given.star_tracker_sigma_arcsec,
        velocity_sigma_m_s=10.0,
        method='per_image',
    )
    for seed in (2, 13, 5):  # rounding decides where a fit of noise ends
        rng, images = np.random.default_rng(seed), []
        for one in ensemble.images:
            few = one.select(np.isin(np.arange(len(one)), rng.permutation(len(one))[:13]))
            noise = rng.normal(size=few.measured_px.shape) * 30.0
            px = middle + (few.measured_px - middle) * (-0.02, 0.02) + noise
            images.append(dataclasses.replace(few, measured_px=px))
        try:
            found = estimate_calibration(Ensemble(tuple(images)), given.prior, options)
        except TooFewObservations as error:
            if 'fit ends at fx' in str(error):
                return
        else:
            assert found.termination == 'iteration_limit'
    raise AssertionError('no fit ends at a camera without a focal length')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('model', 'coefficients', 'chosen'),
    [
        ('plumb_bob', {}, ('plumb_bob',)),
        # 3 px in a corner of this lens, 0.22 from its axis.
        ('thin_prism', {'s1': 0.02, 's2': 0.3}, ('plumb_bob', 'thin_prism', 'tilted')),
    ],
)
def test_the_smallest_model_that_leaves_no_field_is_chosen(model, coefficients, chosen) -> None:
    given: Scenario = of_random_pointings(5, images=6)
    camera, _ = convert(given.truth.camera, model)
    truth = dataclasses.replace(given.truth, camera=camera.replace(**coefficients))
    given = dataclasses.replace(given, truth=truth)
    options = CalibrationOptions(
        star_tracker_sigma_arcsec=given.star_tracker_sigma_arcsec, velocity_sigma_m_s=10.0
    )
    found = solve.estimate_with_smallest_lens(true_observations(given), given.prior, options)
    assert found.geometry.camera.model in chosen
    # Where no model of those that converge is free of a field, the field is in the estimate.
    assert found.termination == 'converged'
    assert honesty(given, found, np.zeros_like)[0] < 2.0
