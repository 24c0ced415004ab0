"""
Which star is which: prediction, acquisition and matching.

Catalog stars are predicted into the image, the common shift and roll that the prior alignment may
be off by is found by a vote of bright sources against bright predictions, the match is checked
against chance, and the predictions are refined until every star can be measured in its own window.
An image that no match explains is refused, never matched wrongly.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import binom, poisson

from starcal_ros.astrometry import apparent_directions, SiteOptions, through_the_air
from starcal_ros.camera import field_radius_rad, line_of_sight, project, project_jacobians
from starcal_ros.catalog import CLOSE_PAIR_RAD, cone, StarCatalog
from starcal_ros.centroiding import (
    CentroidOptions,
    Centroids,
    ImageModel,
    measure_stars,
    model_image,
)
from starcal_ros.detection import (
    Background,
    detect,
    detect_near,
    measure_background,
    Pixels,
    Sources,
)
from starcal_ros.errors import ImageRefused
from starcal_ros.fixed_pattern import NO_HOT_PIXELS, refuse_on_hot_pixels
from starcal_ros.instrument import Instrument, learn, MeasuredStars
from starcal_ros.options import option
from starcal_ros.psf import neighbour_pull_px, stamp_radius_px
from starcal_ros.records import CameraGeometry, Image, StarObservations

Floats = NDArray[np.float64]

_TRACKED = 200  # brightest predictions that are looked for in windows of their own
_TRACKED_ROLL_RAD = 0.01  # a star tracker is off by less about any axis once aligned
_VOTERS = (
    100  # brightest predictions and sources that vote: their pairs fill one histogram at once
)
_PULL_UNCERTAINTY = 0.25  # of a neighbour's light: stars of unlike colour differ so from their V
SPACE = SiteOptions()
_MODELLED_UNCERTAINTY = 0.05  # of that of a star measured itself: wings that are no Gaussian's
_NEAR_SIGMA, _MODELLED_NEAR_SIGMA = 5.0, 3.0  # a bright neighbour nearer than this swamps
_ALONE_SIGMA = 0.1  # a star whose neighbours pull it by less tells the PSF
_PARTS = 3  # of the image along each side, in which a match must hold
_PART_CHANCE = 1e-3  # greatest probability that a right match misses so many in a part
_CHANCE = 1e-9  # greatest probability that a match is accepted by chance


@dataclass(frozen=True)
class IdentificationOptions:
    """How stars are predicted and matched."""

    magnitude_limit: float = option(
        9.0, 'faintest catalog star that is looked for, V magnitude', low=0.0, high=20.0
    )
    acquisition_radius_deg: float = option(
        1.5, 'largest alignment error that is searched, degrees', low=0.05, high=5.0
    )
    acquisition_roll_deg: float = option(
        5.0, 'largest roll error that is searched, degrees', low=0.0, high=20.0
    )
    search_radius_px: int = option(
        12,
        'half width of the window in which a predicted star is first looked for, px',
        low=3,
        high=100,
    )
    min_stars_per_image: int = option(
        8, 'fewest measured stars with which an image is used', low=3, high=1000
    )
    max_blend_sigma: float = option(
        0.3,
        'largest error left of the pull of catalog neighbours on a centroid, in its sigma',
        low=0.0,
        high=100.0,
    )


@dataclass(frozen=True)
class Prediction:
    """
    Catalog stars in and about the image.

    ``catalog_index`` (n,) rows of the catalog, brightest first; ``direction_icrf`` (n, 3),
    apparent; ``direction_camera`` (n, 3); ``xy_px`` (n, 2); ``px_per_rad`` the
    scale of the image, its focal length.
    """

    catalog_index: NDArray[np.int64]
    direction_icrf: Floats
    direction_camera: Floats
    xy_px: Floats
    px_per_rad: float


def predict(
    geometry: CameraGeometry,
    icrf_from_star_tracker_xyzw: Floats,
    time_ns: int,
    catalog: StarCatalog,
    options: IdentificationOptions,
    velocity_m_s: Floats | None = None,
    site: SiteOptions = SPACE,
) -> Prediction:
    """
    Apparent catalog stars where attitude, alignment and camera put them.

    Stars outside the image are kept as far as acquisition may bring them in; those too near to
    the horizon of a site are not.
    """
    camera = geometry.camera
    icrf_from_camera = Rotation.from_quat(icrf_from_star_tracker_xyzw) * Rotation.from_quat(
        geometry.star_tracker_from_camera_xyzw
    )
    margin_px = np.radians(options.acquisition_radius_deg) * camera.parameters[0]
    boresight_icrf = icrf_from_camera.apply([0.0, 0.0, 1.0])
    radius_rad = field_radius_rad(camera, margin_px)
    index = cone(catalog, boresight_icrf, radius_rad, options.magnitude_limit)
    index = index[np.argsort(catalog.magnitude[index], kind='stable')]
    index, direction_icrf = seen(catalog, index, time_ns, velocity_m_s, site)
    direction_camera = icrf_from_camera.inv().apply(direction_icrf)
    xy_px = project(camera, direction_camera)
    with np.errstate(invalid='ignore'):
        # A distortion polynomial folds over far outside: only what the inverse leads back is real.
        near = _in_image(xy_px, camera.width, camera.height, margin_px)
    near[near] &= np.einsum(
        'ij,ij->i', line_of_sight(camera, xy_px[near]), direction_camera[near]
    ) > np.cos(1e-6)
    return Prediction(
        index[near],
        direction_icrf[near],
        direction_camera[near],
        xy_px[near],
        float(camera.parameters[0]),
    )


def seen(
    catalog: StarCatalog,
    index: NDArray[np.intp],
    time_ns: int,
    velocity_m_s: Floats | None,
    site: SiteOptions,
) -> tuple[NDArray[np.intp], Floats]:
    """Those rows (m,) of the catalog that the observer can see, and where (m, 3), ICRF axes."""
    if site.observer != 'ground':
        return index, apparent_directions(catalog.select(index), time_ns, velocity_m_s)
    direction_icrf, elevation_rad = through_the_air(
        apparent_directions(catalog.select(index), time_ns), time_ns, site
    )
    high = elevation_rad >= math.radians(site.min_elevation_deg)
    return index[high], direction_icrf[high]


def _in_image(xy_px: Floats, width: int, height: int, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Return (n,) whether pixels lie in the image widened by a margin."""
    u, v, m = xy_px[:, 0], xy_px[:, 1], margin_px
    return (u > -m) & (u < width - 1 + m) & (v > -m) & (v < height - 1 + m)


def acquire(
    prediction: Prediction,
    sources: Sources,
    geometry: CameraGeometry,
    reach_px: float,
    roll_rad: float,
) -> Rotation:
    """
    Small rotation of the camera frame that brings the predictions onto the sources.

    They may be off by up to ``reach_px``, and rolled by up to ``roll_rad``.

    A vote: for each roll within the limit, the pixel offsets of all pairs of bright sources and
    bright predictions are counted in cells; true pairs share one cell, false ones spread.

    Raises
    ------
    ImageRefused
        ``no_match`` when the best cell holds no more than chance would put there.
    """
    camera = geometry.camera
    width, height = camera.width, camera.height
    half_diagonal_px = 0.5 * np.hypot(width, height)
    # Wide enough for what the prior focal length and the roll step leave at the edge, but a small
    # part of what is searched: a cell as large as the search would count everything.
    cell_px = min(max(3.0, 0.008 * half_diagonal_px), reach_px / 4)
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    stars = prediction.xy_px[:_VOTERS] - centre
    seen = sources.xy_px[:_VOTERS] - centre
    half_cells = int(np.ceil(reach_px / cell_px)) + 1
    cells = 2 * half_cells + 1
    roll_step = cell_px / half_diagonal_px
    roll_steps = int(np.ceil(roll_rad / roll_step))

    best_count, best_roll, best_cell = -1, 0.0, (0, 0)
    # Nearest to zero first: of equal votes the smallest turn wins.
    for step in sorted(range(-roll_steps, roll_steps + 1), key=abs):
        roll = step * roll_step
        offset = seen[:, None] - _turn(stars, roll)[None]
        cell = np.floor(offset / cell_px).astype(np.int64).reshape(-1, 2) + half_cells
        inside = ((cell >= 0) & (cell < cells)).all(axis=1)
        flat = cell[inside, 1] * cells + cell[inside, 0]
        votes = np.bincount(flat, minlength=cells * cells).reshape(cells, cells)
        blocks = votes[:-1, :-1] + votes[1:, :-1] + votes[:-1, 1:] + votes[1:, 1:]
        k = int(blocks.argmax())
        if blocks.flat[k] > best_count:
            best_count = int(blocks.flat[k])
            best_roll, best_cell = roll, (k // (cells - 1), k % (cells - 1))
    low = (np.array([best_cell[1], best_cell[0]]) - half_cells) * cell_px
    offset = seen[:, None] - _turn(stars, best_roll)[None]
    in_block = ((offset >= low) & (offset < low + 2 * cell_px)).all(axis=2)
    expected = len(stars) * len(seen) * (2 * cell_px) ** 2 / sources.searched_px2
    trials = (2 * roll_steps + 1) * cells * cells
    if best_count < 4 or poisson.sf(best_count - 1, expected) * trials > 1e-2:
        raise ImageRefused(
            'no_match',
            f'{best_count} of {min(len(stars), len(seen))} bright stars agree, as by chance',
        )
    shift_px = np.median(offset[in_block], axis=0)
    roll_turn = Rotation.from_rotvec([0.0, 0.0, best_roll])
    middle = line_of_sight(camera, np.stack([centre, centre + shift_px]))
    axis = np.cross(middle[0], middle[1])
    return Rotation.from_rotvec(axis) * roll_turn


def _turn(xy_px: Floats, angle_rad: float) -> Floats:
    """Points (n, 2) turned about the origin from +u towards +v."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(xy_px @ np.array([[c, s], [-s, c]]))


def _pairs(predicted_px: Floats, sources_px: Floats, radius_px: float) -> NDArray[np.int64]:
    """
    Pairs (k, 2) of prediction and source that are each other's nearest within a radius.

    Only mutual nearest neighbours count, so no source and no star is used twice.
    """
    if len(predicted_px) == 0 or len(sources_px) == 0:
        return np.empty((0, 2), np.int64)
    distance, source = cKDTree(sources_px).query(predicted_px, distance_upper_bound=radius_px)
    star = np.nonzero(np.isfinite(distance))[0]
    _, back = cKDTree(predicted_px).query(sources_px[source[star]])
    mutual = back == star
    return np.stack([star[mutual], source[star[mutual]]], axis=-1)


def _refine_rotation(
    prediction: Prediction,
    sources: Sources,
    geometry: CameraGeometry,
    start: Rotation,
    stars: NDArray[np.int64],
) -> tuple[Floats, NDArray[np.int64]]:
    """
    Predicted pixels (n, 2) after rotation and focal scale fit the sources, and their pairs (k, 2).

    Robust Gauss-Newton on the small rotation and one common scale, the radius of matching closing
    in; only ``stars`` (rows of the prediction) and the sources take part.
    """
    camera = geometry.camera
    rotation, scale = start, 1.0
    pairs: NDArray[np.int64] = np.empty((0, 2), np.int64)
    centre = camera.parameters[3:5]
    widest = max(8.0, 0.012 * np.hypot(camera.width, camera.height))
    for radius_px in (widest, widest, widest, widest / 2, widest / 2, widest / 3, widest / 3):
        directions = rotation.apply(prediction.direction_camera)
        xy = (project(camera, directions) - centre) * scale + centre
        pairs = _pairs(xy[stars], sources.xy_px, radius_px)
        if len(pairs) < 4:
            break
        star = stars[pairs[:, 0]]
        residual = sources.xy_px[pairs[:, 1]] - xy[star]
        _, _, J_rotation = project_jacobians(camera, directions[star])
        J = np.concatenate([scale * J_rotation, (xy[star] - centre)[:, :, None]], axis=-1)
        size = np.linalg.norm(residual, axis=1)
        weight = 1.0 / (1.0 + (size / max(float(np.median(size)), 0.3)) ** 2)
        root = np.sqrt(weight)[:, None]
        step = np.linalg.lstsq(
            (J * root[:, :, None]).reshape(-1, 4), (residual * root).ravel(), rcond=1e-10
        )[0]
        rotation = Rotation.from_rotvec(-step[:3]) * rotation
        scale = float(np.clip(scale * (1.0 + step[3]), 0.75, 1.3))
    directions = rotation.apply(prediction.direction_camera)
    xy = (project(camera, directions) - centre) * scale + centre
    return xy, pairs


def _warp_powers(n: int) -> list[tuple[int, int]]:
    """Powers of u and v in the correction that n stars can carry."""
    degree = 5 if n >= 150 else 3 if n >= 36 else 1 if n >= 12 else 0
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def _fit_warp(
    predicted_px: Floats, measured_px: Floats, sigma_px: Floats, at_px: Floats, half_px: float
) -> tuple[Floats, float]:
    """
    Smooth correction (k, 2) at ``at_px`` from predicted to measured, and its robust scatter.

    A polynomial in u and v, of a degree that the number of stars carries (at most 5: the prior
    distortion may be quite unknown), fitted robustly.  Only predictions are corrected by it.
    """
    n = len(predicted_px)
    powers = _warp_powers(n)

    def basis(xy: Floats) -> Floats:
        u, v = ((xy - half_px) / half_px).T
        u_power, v_power = [np.ones_like(u)], [np.ones_like(v)]
        for _ in range(max(i for i, _ in powers)):
            u_power.append(u_power[-1] * u)
            v_power.append(v_power[-1] * v)
        return np.stack([u_power[i] * v_power[j] for i, j in powers])

    A = basis(predicted_px)
    residual = measured_px - predicted_px
    coefficients = np.median(residual, axis=0)[None] * (np.arange(len(powers)) == 0)[:, None]
    scatter = 1.0
    for _ in range(8):
        left = residual - A.T @ coefficients
        size = np.hypot(left[:, 0], left[:, 1])
        before = scatter
        scatter = max(
            1.4826 * float(np.median(size)) / 1.1774, 0.01
        )  # Rayleigh median: 1.1774 sigma
        spread2 = sigma_px**2 + scatter**2
        weight = 1.0 / spread2 / (1.0 + size**2 / (4.0 * spread2)) ** 2
        weighted = A * weight
        normal = weighted @ A.T
        # Powers up to 5 on -1 to 1 leave the normal matrix ten digits; a trace keeps the corner
        # without stars at rest.
        normal[np.diag_indices_from(normal)] *= 1.0 + 1e-9
        coefficients = np.linalg.solve(normal, weighted @ residual)
        if abs(scatter - before) < 0.03 * scatter:
            break
    return basis(at_px).T @ coefficients, scatter


def neighbour_pulls(
    xy_px: Floats,
    magnitude: Floats,
    flux_dn: Floats,
    model: ImageModel,
    modelled: NDArray[np.bool_] | None = None,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """
    How the neighbours of each star pull its centroid.

    ``flux_dn`` (n,) is measured, with what of a neighbour falls into it; the neighbour's follows
    from the difference of the magnitudes.  Where the two are too close to be told apart, the pull
    is from the star to the centre of their light.  The light of stars that are ``modelled`` (n,)
    is taken off already.

    Returns
    -------
    pull_px : (n, 2)
        By those that are not modelled.
    uncertain_px : (n, 2)
        What the pull of all neighbours may be wrong by once it is taken off.
    swamped : (n,)
        Whether a neighbour is too near and too bright for that.
    """
    sigma_px = model.psf_sigma_px or 1.0
    reach_px = stamp_radius_px(sigma_px) * math.sqrt(2.0) + 2.0 * sigma_px
    pairs = cKDTree(xy_px).query_pairs(reach_px, output_type='ndarray')
    star, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    ratio = 10.0 ** (0.4 * (magnitude[star] - magnitude[other]))
    flux = np.maximum(flux_dn[star], 1.0)
    offset_px = xy_px[other] - xy_px[star]
    distance_px = np.linalg.norm(offset_px, axis=1)
    known = np.zeros(len(star), bool) if modelled is None else modelled[other]
    # What two Gaussians have in common: all the light of one that stands behind the other.
    within = np.where(known, 0.0, np.exp(-((0.5 * distance_px / sigma_px) ** 2)))
    pull_px = neighbour_pull_px(
        flux,
        offset_px,
        ratio * flux / (1.0 + ratio * within),
        sigma_px,
        model.background.noise_dn,
        model.pixel_noise,
    )
    total_px, uncertain_px = np.zeros_like(xy_px), np.zeros_like(xy_px)
    np.add.at(total_px, star[~known], pull_px[~known])
    part = np.where(known, _MODELLED_UNCERTAINTY, _PULL_UNCERTAINTY)
    np.add.at(uncertain_px, star, part[:, None] * pull_px)
    # A neighbour half as bright takes part of the window for itself: no small pull any more.  Nor
    # is the centre of a double of like stars used: their orbits, which no catalog of places has,
    # move it by arcseconds (zeta Herculis).
    near = distance_px < np.where(known, _MODELLED_NEAR_SIGMA, _NEAR_SIGMA) * sigma_px
    swamped = np.zeros(len(xy_px), bool)
    swamped[star[near & (ratio > 0.5)]] = True
    return total_px, uncertain_px, swamped


def unlisted_pull_px(magnitude: Floats, faintest: float, px_per_rad: float) -> Floats:
    """
    1-sigma per axis (n,) of the pull of a close companion that the catalog has not.

    It is fainter than the faintest star there, and anywhere within `CLOSE_PAIR_RAD`: on average
    0.58 of that away, with 0.65 of the light that it may have (one magnitude and less), and half
    of the square along each axis.
    """
    ratio = 10.0 ** (0.4 * np.minimum(magnitude - faintest, 0.0))
    return np.asarray(0.58 * 0.65 * math.sqrt(0.5) * CLOSE_PAIR_RAD * px_per_rad * ratio)


def _close(direction: Floats) -> NDArray[np.bool_]:
    """Return (n,) which of some directions have another of them within `CLOSE_PAIR_RAD`."""
    close = np.zeros(len(direction), np.bool_)
    pairs = cKDTree(direction).query_pairs(
        2.0 * math.sin(CLOSE_PAIR_RAD / 2.0), output_type='ndarray'
    )
    close[pairs.ravel()] = True
    return close


def _separate(
    predicted_px: Floats,
    magnitude: Floats,
    unlisted_px: Floats,
    centroids: Centroids,
    model: ImageModel,
    options: IdentificationOptions,
) -> tuple[Centroids, NDArray[np.bool_]]:
    """
    Centroids freed from the light of their neighbours in the catalog, or refused as blends.

    The pull is taken off, and what it may be wrong by is added to the covariance; where that is
    more than ``max_blend_sigma`` the star is of no use.  So it is with ``unlisted_px`` (n,), the
    1-sigma per axis of the pull of companions that are not in the catalog.  Also says (n,) which
    stars stand alone.
    """
    pull_px, uncertain_px, swamped = neighbour_pulls(
        predicted_px, magnitude, centroids.flux_dn, model, centroids.modelled
    )
    sigma_px = np.sqrt(0.5 * (centroids.covariance_px2[:, 0] + centroids.covariance_px2[:, 2]))
    size_px = np.sqrt((uncertain_px**2).sum(axis=1) + 2.0 * unlisted_px**2)
    beyond = size_px > options.max_blend_sigma * sigma_px
    refusal = centroids.refusal.copy()
    refusal[(swamped | beyond) & (refusal == '')] = 'blend'
    u, v = uncertain_px.T
    separated = dataclasses.replace(
        centroids,
        xy_px=centroids.xy_px - pull_px,
        covariance_px2=centroids.covariance_px2
        + np.stack([u * u + unlisted_px**2, u * v, v * v + unlisted_px**2], axis=-1),
        refusal=refusal,
    )
    return separated, size_px < _ALONE_SIGMA * sigma_px


@dataclass(frozen=True)
class Shot:
    """
    One image with what is known of it: where it was taken, and what to measure it with.

    ``hot_pixels`` (k,) are the numbers of pixels, row by row from 0, that spoil a star.
    """

    image: Image
    icrf_from_star_tracker_xyzw: Floats
    attitude_gap_s: float
    velocity_m_s: Floats | None = None
    site: SiteOptions = SPACE
    hot_pixels: NDArray[np.int64] = dataclasses.field(default_factory=lambda: NO_HOT_PIXELS.index)


def observe_stars(
    shot: Shot,
    geometry: CameraGeometry,
    catalog: StarCatalog,
    centroid_options: CentroidOptions,
    options: IdentificationOptions,
) -> tuple[StarObservations, Instrument | None]:
    """
    The stars of one image, searched for, and what they say of the camera's light.

    With too few measured well it is a refused image, ``too_few_stars``, that still says what
    became of each star.

    Raises
    ------
    ImageRefused
        ``no_stars`` or ``no_match``.
    """
    image = shot.image
    background = measure_background(image.pixels)
    prediction = predict(
        geometry,
        shot.icrf_from_star_tracker_xyzw,
        image.time_ns,
        catalog,
        options,
        shot.velocity_m_s,
        shot.site,
    )
    if len(prediction.catalog_index) < 4:
        raise ImageRefused(
            'no_match', f'{len(prediction.catalog_index)} catalog stars in the field'
        )
    predicted_px, sources = _find(
        image.pixels, background, prediction, geometry, centroid_options, options
    )
    model = model_image(image.pixels, background, sources, centroid_options)
    if model.psf is None:
        # The brightest stars may all be saturated: fainter ones tell the PSF.
        sources = detect(image.pixels, background, centroid_options.detection_sigma)
        model = model_image(image.pixels, background, sources, centroid_options)
    prediction = dataclasses.replace(prediction, xy_px=predicted_px)
    return measure_predicted(shot, prediction, model, None, catalog, centroid_options, options)


def measure_predicted(
    shot: Shot,
    prediction: Prediction,
    model: ImageModel,
    instrument: Instrument | None,
    catalog: StarCatalog,
    centroid_options: CentroidOptions,
    options: IdentificationOptions,
) -> tuple[StarObservations, Instrument | None]:
    """
    The stars of an image once it is known where they stand, and what is known of the light then.

    ``instrument`` is what was known before, None at the first image.  With too few stars measured
    well it is a refused image, ``too_few_stars``.
    """
    pixels = shot.image.pixels
    height, width = pixels.shape
    inside = np.nonzero(_in_image(prediction.xy_px, width, height))[0]
    index = prediction.catalog_index[inside]
    predicted_px = prediction.xy_px[inside]
    magnitude = catalog.magnitude[index]
    centroids = measure_stars(pixels, predicted_px, model, centroid_options, shot.hot_pixels)
    unlisted = catalog.close_pair[index] & ~_close(prediction.direction_icrf[inside])
    faintest = float(catalog.magnitude[-1])
    unlisted_px = np.where(
        unlisted, unlisted_pull_px(magnitude, faintest, prediction.px_per_rad), 0.0
    )
    centroids, alone = _separate(predicted_px, magnitude, unlisted_px, centroids, model, options)
    refusal = refuse_on_hot_pixels(
        predicted_px,
        _refuse_displaced(predicted_px, centroids, width),
        shot.hot_pixels,
        width,
        stamp_radius_px(model.psf_sigma_px or 1.0),
    )
    good = refusal == ''
    left_out = ~good
    names, code, counts = np.unique(refusal[left_out], return_inverse=True, return_counts=True)
    few = np.count_nonzero(good) < options.min_stars_per_image
    detail = f'{np.count_nonzero(good)} stars measured well, {options.min_stars_per_image} needed'
    if few:
        good = np.zeros_like(good)
    observations = StarObservations(
        time_ns=shot.image.time_ns,
        width=width,
        height=height,
        refusal='too_few_stars' if few else '',
        detail=detail if few else '',
        icrf_from_star_tracker_xyzw=shot.icrf_from_star_tracker_xyzw,
        attitude_gap_s=shot.attitude_gap_s,
        catalog_id=catalog.id[index][good],
        direction_icrf=prediction.direction_icrf[inside][good],
        magnitude=magnitude[good].astype(np.float32),
        measured_px=centroids.xy_px[good],
        covariance_px2=centroids.covariance_px2[good],
        flux_dn=centroids.flux_dn[good].astype(np.float32),
        snr=centroids.snr[good].astype(np.float32),
        refused_stars=dict(zip(names.tolist(), counts.tolist(), strict=True)),
        refused_catalog_id=catalog.id[index][left_out],
        refused_px=predicted_px[left_out].astype(np.float32),
        refused_reason=code.astype(np.uint8),
        background_dn=model.background.level_dn,
        noise_dn=model.background.noise_dn,
        psf_sigma_px=model.psf_sigma_px,
        catalog_digest=catalog.digest,
    )
    if few or centroids.fit is None:
        return observations, instrument
    stars = MeasuredStars(
        centroids.xy_px, centroids.fit, centroids.psf_sigma_px, centroids.noise_dn, good & alone
    )
    shown_dn = model.saturation_dn if np.isfinite(model.saturation_dn) else 0.0
    return observations, learn(instrument, stars, model.pixel_noise, shown_dn, (width, height))


def tracked(geometry: CameraGeometry, observations: StarObservations) -> CameraGeometry:
    """
    The geometry with which to predict the next image: aligned as this image shows.

    What launch has turned is found once, by the search of a whole image; from then on stars are
    looked for where they are.  A refused image leaves it as it was.
    """
    if observations.refusal:
        return geometry
    camera_from_icrf, _ = Rotation.align_vectors(
        line_of_sight(geometry.camera, observations.measured_px),
        observations.direction_icrf,
        weights=observations.snr.astype(np.float64),
    )
    icrf_from_star_tracker = Rotation.from_quat(observations.icrf_from_star_tracker_xyzw)
    star_tracker_from_camera = icrf_from_star_tracker.inv() * camera_from_icrf.inv()
    return CameraGeometry(geometry.camera, star_tracker_from_camera.as_quat())


def _find(
    pixels: Pixels,
    background: Background,
    prediction: Prediction,
    geometry: CameraGeometry,
    centroid_options: CentroidOptions,
    options: IdentificationOptions,
) -> tuple[Floats, Sources]:
    """
    Predicted pixels (n, 2) refined onto the sources of the image, and those sources.

    First the brighter stars are looked for next to their predictions; only when those do not make
    a match is the whole image searched, and the whole error that launch may have caused.

    Raises
    ------
    ImageRefused
        ``no_stars`` or ``no_match``.
    """
    camera = geometry.camera
    inside = _in_image(prediction.xy_px, camera.width, camera.height)
    near = detect_near(
        pixels,
        background,
        prediction.xy_px[inside][:_TRACKED],
        options.search_radius_px,
        centroid_options.detection_sigma,
    )
    try:
        turn = acquire(
            prediction, near, geometry, float(options.search_radius_px), _TRACKED_ROLL_RAD
        )
        return _match(prediction, near, geometry, turn), near
    except ImageRefused:
        pass
    sources = detect(pixels, background, centroid_options.detection_sigma)
    if len(sources.snr) < 4:
        raise ImageRefused('no_stars', f'{len(sources.snr)} star-like sources')
    turn = acquire(
        prediction,
        sources,
        geometry,
        math.radians(options.acquisition_radius_deg) * float(camera.parameters[0]),
        math.radians(options.acquisition_roll_deg),
    )
    return _match(prediction, sources, geometry, turn), sources


def _match(
    prediction: Prediction, sources: Sources, geometry: CameraGeometry, turn: Rotation
) -> Floats:
    """
    Predicted pixels (n, 2) refined onto the sources, once the match is beyond chance.

    Raises
    ------
    ImageRefused
        ``no_match`` when the refined predictions meet no more sources than chance explains.
    """
    camera = geometry.camera
    # As many predictions as sources and the other way round: the fainter surplus matches nothing.
    bright = np.arange(min(len(prediction.xy_px), 4 * len(sources.snr), 400))
    first = 4 * len(bright)
    seen = dataclasses.replace(sources, xy_px=sources.xy_px[:first], snr=sources.snr[:first])
    xy, pairs = _refine_rotation(prediction, seen, geometry, turn, bright)
    half_px = 0.5 * max(camera.width, camera.height)
    for radius_px in (max(4.0, 0.003 * half_px * 2), 3.0, 2.0):
        if len(pairs) < 4:
            break
        correction, _ = _fit_warp(
            xy[bright[pairs[:, 0]]],
            seen.xy_px[pairs[:, 1]],
            np.full(len(pairs), 0.2),
            xy,
            half_px,
        )
        pairs = _pairs((xy + correction)[bright], seen.xy_px, radius_px)
    if len(pairs) >= 4:
        xy = xy + correction
    inside = _in_image(xy[bright], camera.width, camera.height)
    radius_px = 2.0
    met = _pairs(xy[bright][inside], seen.xy_px, radius_px)
    matched = len(met)
    density = len(seen.snr) / sources.searched_px2
    tried = int(np.count_nonzero(inside))
    expected = tried * -np.expm1(-density * np.pi * radius_px**2)
    # Rotation, scale and warp were fitted to the pairs: two parameters can buy one pair.
    bought = 2 + len(_warp_powers(len(pairs)))
    if matched < 6 or poisson.sf(matched - 1 - bought, expected) > _CHANCE:
        raise ImageRefused(
            'no_match',
            f'{matched} of {tried} predicted stars meet a source, {expected:.0f} would by chance',
        )
    if _matched_in_part(seen, met[:, 1], camera.width, camera.height):
        raise ImageRefused('no_match', 'stars agree in a part of the image only')
    return xy


def _matched_in_part(sources: Sources, met: NDArray[np.int64], width: int, height: int) -> bool:
    """
    Whether the bright sources of most parts of the image meet far fewer predictions than of one.

    ``met`` are the sources that meet one.  In a crowded field a wrong scale or shape can be right
    in one part and chance in the others, and beyond chance in all.  A part without stars, behind a
    cloud, shows no sources and says nothing.
    """
    bright = sources.snr >= np.median(sources.snr[met])
    meets = np.zeros(len(sources.snr), bool)
    meets[met] = True
    cell = np.clip((sources.xy_px * _PARTS / [width, height]).astype(np.int64), 0, _PARTS - 1)
    cell_of = cell[:, 1] * _PARTS + cell[:, 0]
    shown = np.bincount(cell_of[bright], minlength=_PARTS**2)
    found = np.bincount(cell_of[bright & meets], minlength=_PARTS**2)
    told = shown >= 4
    if np.count_nonzero(told) < 2:
        return False
    best = float((found[told] / (shown[told] + 1.0)).max())
    # Not by a little: a cosmic ray is several sources in one place.
    missed = (binom.cdf(found[told], shown[told], best) < _PART_CHANCE) & (
        found[told] < best / 3 * shown[told]
    )
    return bool(2 * np.count_nonzero(missed) > np.count_nonzero(told))


def _refuse_displaced(predicted_px: Floats, centroids: Centroids, width: int) -> NDArray[np.str_]:
    """
    Refusal names (n,): those of the centroids, and of stars off their place.

    The measured stars themselves give the smooth correction against which a place is judged.
    """
    refusal = centroids.refusal.copy()
    sigma_px = np.sqrt(0.5 * (centroids.covariance_px2[:, 0] + centroids.covariance_px2[:, 2]))
    good = np.nonzero(refusal == '')[0]
    if len(good) < 4:
        return refusal
    correction, scatter_px = _fit_warp(
        predicted_px[good], centroids.xy_px[good], sigma_px[good], predicted_px[good], 0.5 * width
    )
    off_px = np.linalg.norm(centroids.xy_px[good] - predicted_px[good] - correction, axis=1)
    limit_px = np.maximum(5.0 * np.hypot(sigma_px[good], 0.5 * scatter_px), 0.3)
    refusal[good[off_px > np.minimum(limit_px, 2.0)]] = 'ambiguous'
    return refusal
