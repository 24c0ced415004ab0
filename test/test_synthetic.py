"""Synthetic star fields against analytic truth, noise statistics and plain least squares."""

from __future__ import annotations

import dataclasses
import math

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.camera import project, project_jacobians
from starcal_ros.catalog import StarCatalog
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.synthetic import (
    attitude_samples,
    BOUND_NAMES,
    camera_from_icrf,
    centroid_bound,
    cosmic_ray_electrons,
    cramer_rao_covariance,
    Detector,
    expose,
    fixed_pattern,
    Inertial,
    render,
    scenario,
    SCENARIOS,
    scene,
    star_electrons,
    true_observations,
)

QUIET = Detector(cosmic_rays=0.0, hot_fraction=0.0)


def random_catalog(seed: int, count: int = 40_000, faintest: float = 9.0) -> StarCatalog:
    """Stars all over the sky, as many more of each magnitude as there really are."""
    rng = np.random.default_rng(seed)
    zero = np.zeros(count)
    return StarCatalog(
        id=np.arange(count, dtype=np.int64) + 1,
        ra_rad=rng.uniform(0, 2 * np.pi, count),
        dec_rad=np.arcsin(rng.uniform(-1, 1, count)),
        pm_ra_cosdec_rad_per_year=zero,
        pm_dec_rad_per_year=zero,
        parallax_rad=zero,
        magnitude=np.sort(faintest + np.log10(rng.uniform(size=count)) / 0.5),
        colour_bp_rp=zero,
        motion_source=zero.astype(np.uint8),
        close_pair=zero.astype(np.bool_),
        epoch_jyear=2016.0,
        digest='random',
    )


CATALOG = random_catalog(1)


@pytest.mark.parametrize('sigma_px', [0.6, 0.95, 1.5])
def test_a_star_has_its_flux_at_its_place(sigma_px: float) -> None:
    pixels = np.array([[20.0, 21.0], [41.3, 20.8], [19.5, 44.5], [45.02, 47.77]])
    flux = np.array([1e4, 2e4, 3e4, 4e4])
    image = star_electrons(pixels, flux, sigma_px, (64, 70))
    v, u = np.mgrid[:64, :70]
    for (u0, v0), electrons in zip(pixels, flux, strict=True):
        near = image * (np.hypot(u - u0, v - v0) < 11)
        # 6 sigma stamps: 2e-9 of the light is left out on each side.
        assert near.sum() == pytest.approx(electrons, rel=1e-8)
        # Sampling at one pixel moves the centre of intensity by exp(-2 pi^2 sigma^2) / pi px
        # (the first alias): 3e-4 px for the sharpest of these.
        alias_px = math.exp(-2 * math.pi**2 * sigma_px**2) / math.pi
        assert abs((near * u).sum() / near.sum() - u0) < 1.01 * alias_px + 1e-7
        assert abs((near * v).sum() / near.sum() - v0) < 1.01 * alias_px + 1e-7


def test_a_pixel_holds_the_integral_of_the_gaussian() -> None:
    image = star_electrons(np.array([[10.3, 9.6]]), np.array([1.0]), 0.95, (20, 20))
    fine = (np.arange(-500, 500) + 0.5) / 1000
    along_u = np.exp(-((11 + fine - 10.3) ** 2) / (2 * 0.95**2))
    along_v = np.exp(-((8 + fine - 9.6) ** 2) / (2 * 0.95**2))
    expected = along_u.mean() * along_v.mean() / (2 * math.pi * 0.95**2)
    assert image[8, 11] == pytest.approx(expected, rel=1e-6)  # midpoint rule with 1e-3 px steps


def test_light_of_stars_at_the_border_is_cut_there() -> None:
    pixels = np.array([[-0.5, 10.0], [30.0, 19.5], [-50.0, -50.0]])
    image = star_electrons(pixels, np.array([1000.0, 500.0, 1e6]), 1.0, (20, 40))
    # A star on the outer edge of the border pixels leaves one half inside.
    assert image.sum() == pytest.approx(500 + 250, rel=1e-8)


def test_noise_has_the_mean_and_variance_of_its_sources() -> None:
    detector = dataclasses.replace(QUIET, electrons_per_dn=2.0, read_noise_electrons=5.0)
    count = 400_000
    for mean in (0.0, 4.5, 200.0):
        counts = expose(np.full((400, 1000), mean), detector, np.random.default_rng(3))
        electrons = (counts.astype(np.float64) - detector.offset_dn) * detector.electrons_per_dn
        variance = mean + 5.0**2 + 2.0**2 / 12  # photons, reading, rounding
        # Five standard errors of a mean, and of a variance of nearly Gaussian noise.
        assert abs(electrons.mean() - mean) < 5 * math.sqrt(variance / count)
        assert abs(electrons.var() / variance - 1) < 5 * math.sqrt(2 / count)


def test_background_noise_is_what_the_detector_says() -> None:
    counts = expose(
        np.full((500, 800), QUIET.background_electrons), QUIET, np.random.default_rng(4)
    )
    expected_dn = QUIET.noise_electrons / QUIET.electrons_per_dn
    assert counts.std() == pytest.approx(expected_dn, rel=5 / math.sqrt(2 * counts.size))


@pytest.mark.parametrize(('bits', 'dtype'), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_the_converter_saturates(bits: int, dtype: type) -> None:
    detector = dataclasses.replace(QUIET, bits=bits)
    counts = expose(np.array([[1e7, 0.0]]), detector, np.random.default_rng(5))
    assert counts.dtype == dtype
    assert counts[0, 0] == 2**bits - 1
    dark = dataclasses.replace(detector, offset_dn=-1000.0)
    assert expose(np.zeros((2, 2)), dark, np.random.default_rng(5)).max() == 0


def test_hot_pixels_stay_where_they_are() -> None:
    tiny = scenario('tiny')
    pattern = fixed_pattern(tiny)
    hot = pattern > tiny.detector.background_electrons
    assert hot.sum() == round(tiny.detector.hot_fraction * pattern.size)
    assert np.array_equal(pattern, fixed_pattern(tiny))
    first, second = (
        render(tiny, scene(tiny, index, CATALOG), index, pattern).pixels for index in (0, 1)
    )
    hottest = pattern > 1000
    expected_dn = (
        tiny.detector.offset_dn + pattern[hottest].mean() / tiny.detector.electrons_per_dn
    )
    for pixels in (first, second):
        # Photon noise of a kilo-electron and 8 e- reading over some ten pixels: 2 per cent.
        assert pixels[hottest].mean() == pytest.approx(expected_dn, rel=0.1)


def test_cosmic_rays_leave_tracks() -> None:
    detector = dataclasses.replace(QUIET, cosmic_rays=50.0)
    signal = cosmic_ray_electrons(detector, (512, 640), np.random.default_rng(6))
    lit = np.count_nonzero(signal)
    # Tracks of 4 px in the mean, 50 of them, less those over the border: several pixels each.
    assert 100 < lit < 1000
    # Log-normal charge: mean 3000 exp(0.7^2 / 2) = 3833 e- a track; 50 +- 7 tracks of it.
    assert 50 * 3833 * 0.5 < signal.sum() < 50 * 3833 * 1.5
    none = dataclasses.replace(QUIET, cosmic_rays=0.0)
    assert not cosmic_ray_electrons(none, (512, 640), np.random.default_rng(6)).any()


def test_an_image_is_the_same_whatever_was_made_before() -> None:
    tiny = scenario('tiny', 7)
    alone = render(tiny, scene(tiny, 3, CATALOG), 3)
    render(tiny, scene(tiny, 2, CATALOG), 2)
    again = render(scenario('tiny', 7), scene(tiny, 3, CATALOG), 3, fixed_pattern(tiny))
    assert alone.time_ns == again.time_ns
    assert np.array_equal(alone.pixels, again.pixels)
    other = dataclasses.replace(tiny, seed=8)
    assert not np.array_equal(alone.pixels, render(other, scene(other, 3, CATALOG), 3).pixels)


def test_the_seed_draws_the_truth_but_not_the_prior() -> None:
    for name in SCENARIOS:
        a, b, again = scenario(name, 1), scenario(name, 2), scenario(name, 1)
        assert np.array_equal(a.truth.camera.parameters, again.truth.camera.parameters)
        assert not np.array_equal(a.truth.camera.parameters, b.truth.camera.parameters)
        assert np.array_equal(a.prior.camera.parameters, b.prior.camera.parameters)
        # The principal point cannot be told from the alignment: it is as the prior has it.
        assert np.array_equal(a.truth.camera.parameters[3:5], a.prior.camera.parameters[3:5])
    with pytest.raises(ValueError, match="'huge' is not one of tiny, small, paper"):
        scenario('huge')


def test_rendered_stars_stand_where_the_camera_puts_them() -> None:
    tiny = scenario('tiny')
    shown = scene(tiny, 4, CATALOG)
    pixels = render(tiny, shown, 4).pixels.astype(np.float64)
    directions = shown.direction_icrf @ shown.camera_from_icrf.T
    assert np.allclose(project(tiny.truth.camera, directions), shown.pixel_px, atol=1e-9)
    inside = (shown.pixel_px > 10).all(axis=1) & (shown.pixel_px < [629, 501]).all(axis=1)
    bright = np.flatnonzero(inside)[np.argsort(shown.magnitude[inside])[:10]]
    detector = tiny.detector
    mean = star_electrons(shown.pixel_px, shown.flux_electrons, detector.psf_sigma_px, (512, 640))
    for k in bright:
        u, v = np.rint(shown.pixel_px[k]).astype(int)
        window = np.s_[v - 3 : v + 4, u - 3 : u + 4]
        star = (pixels[window] - detector.offset_dn) * detector.electrons_per_dn
        star -= detector.background_electrons
        expected = mean[window].sum()
        assert expected > 0.99 * shown.flux_electrons[k]  # with what neighbours add
        noise = math.sqrt(expected + star.size * detector.noise_electrons**2)
        assert abs(star.sum() - expected) < 5 * noise


def test_an_inertial_camera_looks_where_it_is_told() -> None:
    tiny = scenario('tiny')
    assert isinstance(tiny.pointing, Inertial)
    for index, (ra, dec, roll) in enumerate(tiny.pointing.attitudes_deg):
        R = camera_from_icrf(tiny, index)
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert np.allclose(R[2], erfa.s2c(math.radians(ra), math.radians(dec)), atol=1e-14)
        east = erfa.s2c(math.radians(ra + 90), 0.0)
        # The roll turns +x from east: the angle between them is the roll itself.
        assert R[0] @ east == pytest.approx(math.cos(math.radians(roll)), abs=1e-14)


def test_an_earth_fixed_camera_looks_at_the_zenith() -> None:
    paper = scenario('paper')
    for index in (0, 358):
        utc = 2440587.5, paper.time_ns(index) / 86400e9
        ra, dec = erfa.atoc13(
            'A', 0.0, 0.0, *utc, 0.0, math.radians(-95.37), math.radians(29.76),
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
        boresight = camera_from_icrf(paper, index)[2]
        # ERFA takes off the aberration, 20.5" at most, which a camera's attitude does not have.
        assert erfa.sepp(boresight, erfa.s2c(ra, dec)) < 30 * ARCSECOND_RAD
    # Hercules: 16 h to 18 h, about 30 degrees north.
    ra, dec = erfa.c2s(camera_from_icrf(paper, 180)[2])
    assert 16 < math.degrees(ra % (2 * math.pi)) / 15 < 18
    assert 25 < math.degrees(dec) < 35


def test_star_tracker_errors_have_their_sigma_about_their_axes() -> None:
    paper = dataclasses.replace(
        scenario('paper'), star_tracker_sigma_arcsec=(5.0, 10.0, 40.0), image_count=300
    )
    camera_from_tracker = Rotation.from_quat(paper.truth.star_tracker_from_camera_xyzw).inv()
    errors = []
    for index in range(paper.image_count):
        before, _, after, last = attitude_samples(paper, index)
        tracker_from_icrf = camera_from_tracker.inv() * Rotation.from_matrix(
            camera_from_icrf(paper, index, -0.75)
        )
        reported = Rotation.from_quat(before.icrf_from_star_tracker_xyzw)
        errors.append((tracker_from_icrf * reported).as_rotvec() / ARCSECOND_RAD)
        # One error per image: between two samples the tracker turns as the Earth does.
        turned = reported.inv() * Rotation.from_quat(last.icrf_from_star_tracker_xyzw)
        assert turned.magnitude() == pytest.approx(1.5 * 7.292115e-5, rel=1e-6)
        assert after.time_ns - before.time_ns == 1_000_000_000
    sigma = np.std(errors, axis=0)
    assert np.allclose(sigma, [5.0, 10.0, 40.0], rtol=5 / math.sqrt(2 * 300))  # 5 standard errors


def test_observations_are_exact_without_noise() -> None:
    tiny = dataclasses.replace(scenario('tiny'), image_count=3)
    ensemble = true_observations(tiny, catalog=CATALOG, centroid_noise=False, attitude_noise=False)
    assert len(ensemble.images) == 3 and ensemble.star_count > 100
    camera_from_tracker = Rotation.from_quat(tiny.truth.star_tracker_from_camera_xyzw).inv()
    for image in ensemble.images:
        attitude = Rotation.from_quat(image.icrf_from_star_tracker_xyzw).inv()
        in_camera = (camera_from_tracker * attitude).apply(image.direction_icrf)
        assert np.allclose(project(tiny.truth.camera, in_camera), image.measured_px, atol=1e-9)
        assert image.snr.min() > 5
        assert image.catalog_digest == 'random'


def test_observations_have_the_noise_they_report() -> None:
    tiny = scenario('tiny')
    exact = true_observations(tiny, catalog=CATALOG, centroid_noise=False)
    for sigma_px in (None, 0.2):
        noisy = true_observations(tiny, sigma_px, catalog=CATALOG)
        chi2 = count = 0.0
        for a, b in zip(noisy.images, exact.images, strict=True):
            assert np.array_equal(a.catalog_id, b.catalog_id)
            uu, uv, vv = a.covariance_px2.T
            du, dv = (a.measured_px - b.measured_px).T
            chi2 += float(((vv * du**2 - 2 * uv * du * dv + uu * dv**2) / (uu * vv - uv**2)).sum())
            count += 2 * len(a)
        assert abs(chi2 / count - 1) < 5 * math.sqrt(2 / count)  # 5 standard errors of chi^2
        if sigma_px:
            assert np.allclose(noisy.images[0].covariance_px2, [0.04, 0.0, 0.04])


@pytest.mark.parametrize(('electrons', 'phase'), [(300.0, 0.0), (3000.0, 0.5), (30000.0, 0.23)])
def test_the_bound_is_the_scatter_of_fits_to_noisy_stars(electrons: float, phase: float) -> None:
    """
    Many images of one star, each with its weighted least-squares step from the truth.

    That step is efficient, so its scatter is the bound if both the derivatives and the noise that
    the bound supposes are those of the pixels.
    """
    side, count = 13, 3000
    place = np.array([[6.0 + phase, 6.0 - phase]])
    flux = np.array([electrons])

    def mean_of(u: float, v: float, f: float) -> np.ndarray:
        star = star_electrons(np.array([[u, v]]), np.array([f]), QUIET.psf_sigma_px, (side, side))
        return star + QUIET.background_electrons

    (u, v), h = place[0], 1e-4
    mean = mean_of(u, v, electrons)
    J = np.stack(
        [
            (mean_of(u + h, v, electrons) - mean_of(u - h, v, electrons)) / (2 * h),
            (mean_of(u, v + h, electrons) - mean_of(u, v - h, electrons)) / (2 * h),
            (mean - QUIET.background_electrons) / electrons,
        ],
        axis=-1,
    ).reshape(-1, 3)
    stack = expose(np.broadcast_to(mean, (count, side, side)), QUIET, np.random.default_rng(9))
    data = (stack.astype(np.float64) - QUIET.offset_dn) * QUIET.electrons_per_dn - mean
    weight = 1 / (mean.ravel() + QUIET.noise_electrons**2 - QUIET.background_electrons)
    N = J.T @ (weight[:, None] * J)
    errors = data.reshape(count, -1) @ (weight[:, None] * J) @ np.linalg.inv(N)
    covariance, snr = centroid_bound(place, flux, QUIET, (side, side))
    scatter = np.cov(errors, rowvar=False)
    # 5 standard errors of a variance over 3000 draws: 13 per cent.
    assert np.allclose(np.diag(scatter)[:2], np.diag(covariance[0]), rtol=5 * math.sqrt(2 / count))
    assert electrons / math.sqrt(scatter[2, 2]) == pytest.approx(
        snr[0], rel=5 / math.sqrt(2 * count)
    )


def test_saturated_and_absent_stars_have_no_use() -> None:
    place = np.array([[20.0, 20.0], [20.0, 20.0], [-30.0, 20.0], [-0.5, 20.0]])
    flux = np.array([1e4, 1e8, 1e4, 1e4])
    covariance, snr = centroid_bound(place, flux, QUIET, (40, 40))
    normal, saturated, absent, at_border = covariance[:, 0, 0]
    assert normal < 1e-2 < normal * 1e2
    assert saturated > normal / 1e4  # its wings still tell something, its core nothing
    assert absent > 1e3 and snr[2] < 0.01
    assert at_border > 1.5 * normal  # half of its light


def test_parameter_bound_is_the_inverse_of_the_dense_information_matrix() -> None:
    tiny = dataclasses.replace(scenario('tiny'), image_count=3)
    N = np.zeros((8 + 9, 8 + 9))
    columns = [0, 1, 2, 5, 6, 7, 8, 9]
    for index, image in enumerate(true_observations(tiny, catalog=CATALOG).images):
        R = camera_from_icrf(tiny, index)
        _, J_parameters, J_rotation = project_jacobians(
            tiny.truth.camera, image.direction_icrf @ R.T
        )
        J = np.zeros((len(image), 2, 17))
        J[..., :8] = J_parameters[..., columns]
        J[..., 8 + 3 * index : 11 + 3 * index] = J_rotation
        uu, uv, vv = image.covariance_px2.T
        W = np.linalg.inv(np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2))
        N += np.einsum('nia,nij,njb->ab', J, W, J)
    scale = 1 / np.sqrt(np.diag(N))
    dense = np.linalg.inv(N * np.outer(scale, scale)) * np.outer(scale, scale)
    bound = cramer_rao_covariance(tiny, catalog=CATALOG)
    # The scaled matrix has a condition of about 1e6: 1e-16 of rounding becomes 1e-10.
    assert np.allclose(bound, dense[:8, :8], rtol=1e-7, atol=0)


def test_parameter_bound_is_the_scatter_of_least_squares() -> None:
    """Monte Carlo of a plain least squares: camera and a free attitude for each image."""
    tiny = dataclasses.replace(scenario('tiny'), image_count=3)
    exact = true_observations(tiny, catalog=CATALOG, centroid_noise=False)
    columns = [0, 1, 2, 5, 6, 7, 8, 9]
    rows, roots = [], []
    for index, image in enumerate(exact.images):
        in_camera = image.direction_icrf @ camera_from_icrf(tiny, index).T
        _, J_parameters, J_rotation = project_jacobians(tiny.truth.camera, in_camera)
        J = np.zeros((len(image), 2, 17))
        J[..., :8] = J_parameters[..., columns]
        J[..., 8 + 3 * index : 11 + 3 * index] = J_rotation
        uu, uv, vv = image.covariance_px2.T
        covariance = np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2)
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        roots.append(root)
        rows.append((root @ J).reshape(-1, 17))
    A = np.concatenate(rows)
    scale = np.linalg.norm(A, axis=0)
    estimator = np.linalg.pinv(A / scale) / scale[:, None]
    errors = []
    for seed in range(200):
        noisy = true_observations(dataclasses.replace(tiny, seed=seed), catalog=CATALOG)
        residual = [
            np.einsum('nij,nj->ni', root, a.measured_px - b.measured_px).ravel()
            for root, a, b in zip(roots, noisy.images, exact.images, strict=True)
        ]
        errors.append(estimator[:8] @ np.concatenate(residual))
    bound = cramer_rao_covariance(tiny, catalog=CATALOG)
    whitened = np.linalg.solve(np.linalg.cholesky(bound), np.array(errors).T)
    # 200 runs of 8 parameters: their normalised squares have mean 1, standard error 0.035.
    assert abs((whitened**2).mean() - 1) < 5 * math.sqrt(2 / whitened.size)
    assert len(BOUND_NAMES) == len(whitened)
