# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Stars of one image without a track: prediction, acquisition and measurement.

Sources near the predicted pixels correct the prediction; if they do not match it, `acquisition`
searches the whole image.  `blending` corrects the centroids for neighbours, and a star that is
displaced from the position predicted by the others is refused.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Pixels
from starcal_ros.camera import CameraModel, field_radius_rad, line_of_sight
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.acquisition import acquire
from starcal_ros.identification.blending import separate
from starcal_ros.identification.match_checks import find_line_loss, refuse_by_brightness
from starcal_ros.identification.prediction import (
    deeper_stars,
    fit_warp,
    in_image,
    predict,
    Prediction,
    SPACE,
    window_area,
)
from starcal_ros.options import option
from starcal_ros.records import CameraGeometry, Image, StarObservations, StarRefusal
from starcal_ros.sky.astrometry import (
    air_above,
    EARTH,
    julian_year,
    MIN_ELEVATION_DEG,
    SiteOptions,
    Velocity,
)
from starcal_ros.sky.catalog import sky_circle, StarCatalog
from starcal_ros.stars import detection
from starcal_ros.stars.centroiding import (
    Centroids,
    learn,
    measure_stars,
    shape_changed,
    with_faint,
)
from starcal_ros.stars.hot_pixels import NO_HOT_PIXELS, refuse_on_hot_pixels
from starcal_ros.stars.image_model import CentroidOptions, ImageModel, Instrument, model_image
from starcal_ros.stars.psf_fit import stamp_radius_px
from starcal_ros.stars.streak import Streak, without_streaks
from starcal_ros.text import counted

_SEARCH_SIGMAS = 3.0
_CENTRE_SIGMA = 0.01  # 1-sigma of the principal point, in longer image sides
_ROLL_FACTOR = 10.0 / 3.0  # a mounting is measured with less accuracy about the line of sight
SEARCH_RADIUS_PX = 12  # half width of the window around a predicted star, with a known alignment
_DEEPER_SIGMA = 4.0  # distance from which a star that is not measured pulls no centroid
_ON_STAR_PX = 2.0  # largest distance of the prediction of a source that shows the PSF
_SHOW_PSF = 80  # the brightest sources do
_MIN_STARS = 5  # in an image; fewer may match by chance
_FEWEST_IN_FIELD = 2.0  # catalog stars in an image, on average over the window of the search
_NEAREST = 200  # brightest predictions, searched in windows first
_NEAREST_ROLL_RAD = 0.01  # an aligned star tracker has smaller errors about any axis


@dataclass(frozen=True)
class IdentificationOptions:
    """Prediction and identification of stars."""

    magnitude_limit: float = option(
        9.0, 'faintest catalog star to search for, V magnitude', low=0.0, high=20.0, basic=True
    )
    max_brightness_scatter_mag: float = option(
        0.75,
        'largest scatter of measured against catalog magnitudes, mag; beyond it the match is'
        ' rejected as false; raise it for a band far from V; 100: no check',
        low=0.3,
        high=100.0,
    )
    prior_alignment_sigma_deg: float = option(
        0.5,
        '1-sigma uncertainty of prior_alignment in pointing, degrees, and 3.3 times as much in'
        ' roll; images are searched to 3 sigma; state it for fields under 3 degrees',
        low=1e-4,
        high=10.0,
    )


@dataclass(frozen=True)
class StarSearch:
    """
    Catalog and options with which the stars of an image are found and measured.

    ``tracker_sigma_rad`` is the assumed 1-sigma of an attitude about its worst axis.
    """

    catalog: StarCatalog
    centroid: CentroidOptions = dataclasses.field(default_factory=CentroidOptions)
    identification: IdentificationOptions = dataclasses.field(
        default_factory=IdentificationOptions
    )
    tracker_sigma_rad: float = 0.0

    def reach_rad(self, camera: CameraModel) -> tuple[float, float]:
        """
        Largest error of a prediction in pointing and in roll.

        In pointing those of the mounting, the principal point, and the star tracker in this image;
        once aligned to an image, the star tracker's in both.
        """
        mounting_rad = math.radians(self.identification.prior_alignment_sigma_deg)
        tracker_rad = self.tracker_sigma_rad
        centre_rad = _CENTRE_SIGMA * max(camera.width, camera.height) / float(camera.parameters[0])
        tilt_rad = math.hypot(mounting_rad, tracker_rad, tracker_rad, centre_rad)
        roll_rad = _ROLL_FACTOR * math.hypot(mounting_rad, tracker_rad, tracker_rad)
        return _SEARCH_SIGMAS * tilt_rad, _SEARCH_SIGMAS * roll_rad


@dataclass(frozen=True)
class Exposure:
    """
    One image with its attitude, observer velocity, site and hot pixels.

    ``hot_pixels`` (k,) are flat pixel indices, row by row.
    """

    image: Image
    icrf_from_star_tracker_xyzw: Floats
    attitude_gap_s: float
    velocity: Velocity = EARTH
    site: SiteOptions = SPACE
    hot_pixels: Indices = dataclasses.field(default_factory=lambda: NO_HOT_PIXELS.index)
    temperature_degc: float = math.nan


def observe_stars(
    exposure: Exposure, geometry: CameraGeometry, search: StarSearch
) -> tuple[StarObservations, Instrument | None]:
    """
    Observations of one image without a track, and the PSF and gain measured from them.

    With too few measured stars the observations have the refusal ``too_few_stars`` and still list
    the refusal reason of each star.

    Raises ImageRefused ``no_stars``, ``smeared``, ``no_match``, ``not_in_catalog`` or
    ``incomplete``.
    """
    image = exposure.image
    background = detection.measure_background(image.pixels)
    prediction = predicted(exposure, geometry, search, search.reach_rad(geometry.camera)[0])
    _check_catalog(prediction, exposure, geometry, search)
    predicted_px, sources, streak = _find(image.pixels, background, prediction, search)
    # Cosmic rays and hot pixels may be brighter than the stars, and are sharper: the median of the
    # sources bears some, not most.
    off_px, _ = cKDTree(np.nan_to_num(predicted_px, nan=-1e6)).query(sources.xy_px)
    is_star = off_px < _ON_STAR_PX
    of_brightest = is_star[:_SHOW_PSF]
    are_most = 2 * np.count_nonzero(of_brightest) > len(of_brightest)
    stars = sources if are_most else sources.select(is_star)
    model = model_image(image.pixels, background, stars, search.centroid, streak, sources)
    if model.psf is None:
        # The brightest stars may all be saturated: fit the PSF to fainter ones.
        sources = detection.detect(image.pixels, background)
        sources, streak = without_streaks(image.pixels, background, sources, geometry.camera)
        model = model_image(image.pixels, background, sources, search.centroid, streak)
    prediction = dataclasses.replace(prediction, xy_px=predicted_px)
    return measure_predicted(exposure, prediction, model, None, search)


def predicted(
    exposure: Exposure, geometry: CameraGeometry, search: StarSearch, margin_rad: float
) -> Prediction:
    """Catalog stars in an image and up to a margin outside of it, by its attitude."""
    return predict(
        geometry,
        exposure.icrf_from_star_tracker_xyzw,
        exposure.image.time_ns,
        search.catalog,
        search.identification.magnitude_limit,
        margin_rad,
        exposure.velocity.m_s,
        exposure.site,
    )


def measure_predicted(
    exposure: Exposure,
    prediction: Prediction,
    model: ImageModel,
    instrument: Instrument | None,
    search: StarSearch,
) -> tuple[StarObservations, Instrument | None]:
    """
    Observations from corrected predictions, and the updated PSF and gain.

    ``instrument`` is the PSF and gain of earlier images, None at the first image.  With too few
    measured stars the observations have the refusal ``too_few_stars``.

    Streaks that the instrument does not have are measured, and leave it unchanged.

    Raises ImageRefused ``incomplete`` if image lines are lost, ``no_match`` if the brightnesses
    contradict the catalog or too few streaks are alone, ``smeared`` where they are too long.
    """
    catalog, options = search.catalog, search.identification
    pixels, hot_pixels = exposure.image.pixels, exposure.hot_pixels
    is_inside = in_image(prediction.xy_px, prediction.camera)
    shown, beyond = prediction.select(is_inside), prediction.select(~is_inside)
    least_snr = search.centroid.min_snr
    count = detection.detectable_count(pixels, shown.xy_px, model.background, least_snr)
    looked_at = shown.select(np.arange(len(shown.xy_px)) < count)
    measured = measure_stars(pixels, looked_at.xy_px, model, search.centroid, hot_pixels)
    keeps_instrument = False
    if instrument is not None and shape_changed(measured, model):
        model = _with_streaks(exposure.image, looked_at, measured, model, search.centroid)
        keeps_instrument = model.streak is not None
        if keeps_instrument:
            measured = measure_stars(pixels, looked_at.xy_px, model, search.centroid, hot_pixels)
    # Faint stars are refused, but their light may pull the centroids of the others.
    faint = with_faint(measured, shown.xy_px)
    deeper_px, deeper_mag = deeper_stars(
        shown,
        faint.refusal == StarRefusal.NONE,
        _DEEPER_SIGMA * model.extent_px,
        catalog.deeper,
        exposure.image.time_ns,
        exposure.velocity.m_s,
        exposure.site,
    )
    # The light of a star beyond the border pulls those inside.
    unmeasured = (
        np.concatenate([deeper_px, beyond.xy_px]),
        np.concatenate([deeper_mag, catalog.magnitude[beyond.catalog_index]]),
    )
    centroids, alone = separate(shown, catalog, faint, model, unmeasured)
    _refuse_line_loss(shown.xy_px, centroids, pixels.shape)
    refusal = refuse_on_hot_pixels(
        shown.xy_px,
        _refuse_displaced(shown, centroids),
        hot_pixels,
        shown.camera.width,
        stamp_radius_px(model.psf_sigma_px or 1.0, model.longest_streak_px),
        model.blurred_px,
    )
    magnitude = catalog.magnitude[shown.catalog_index]
    centroids = dataclasses.replace(centroids, refusal=refusal)
    most_mag = options.max_brightness_scatter_mag
    refusal = refuse_by_brightness(magnitude, shown.xy_px, centroids, model, least_snr, most_mag)
    centroids = dataclasses.replace(centroids, refusal=refusal)
    observations = _observations(exposure, shown, catalog, centroids, model)
    if observations.refusal or keeps_instrument:
        return observations, instrument
    usable = (refusal == StarRefusal.NONE) & alone
    return observations, learn(instrument, measured, usable, model)


def _with_streaks(
    image: Image,
    shown: Prediction,
    measured: Centroids,
    model: ImageModel,
    options: CentroidOptions,
) -> ImageModel:
    """Model of an image whose stars are streaks; unchanged without: the focus may have drifted."""
    snr = np.nan_to_num(measured.snr)
    order = np.argsort(-snr, kind='stable')
    sources = detection.Sources(shown.xy_px[order], snr[order], float(image.pixels.size))
    sources, streak = without_streaks(image.pixels, model.background, sources, shown.camera)
    if streak is None:
        return model
    streaked = model_image(image.pixels, model.background, sources, options, streak)
    if streaked.psf is None:
        raise ImageRefused('no_match', 'the stars are streaks, and too few of them are alone')
    return streaked


def _observations(
    exposure: Exposure,
    prediction: Prediction,
    catalog: StarCatalog,
    centroids: Centroids,
    model: ImageModel,
) -> StarObservations:
    """Observations with used and refused stars; refused as a whole with too few stars."""
    height, width = exposure.image.pixels.shape
    index = prediction.catalog_index
    good = centroids.refusal == StarRefusal.NONE
    left_out = ~good
    refusals, reason, counts = np.unique(
        centroids.refusal[left_out], return_inverse=True, return_counts=True
    )
    names = [StarRefusal(code).label for code in refusals]
    others = ', '.join(f'{n} {name}' for name, n in zip(names, counts, strict=True))
    measured = np.count_nonzero(good)
    few = measured < _MIN_STARS
    detail = (
        f'{counted(measured, "star")} measured, {_MIN_STARS} needed; others: {others or "none"}'
    )
    if few:
        good = np.zeros_like(good)
    sigma_rad = catalog.place_sigma_rad(index[good], julian_year(exposure.image.time_ns))
    place_px2 = (sigma_rad * prediction.px_per_rad) ** 2
    zenith_icrf, refraction_arcsec = air_above(exposure.image.time_ns, exposure.site)
    return StarObservations(
        time_ns=exposure.image.time_ns,
        width=width,
        height=height,
        refusal='too_few_stars' if few else '',
        detail=detail if few else '',
        icrf_from_star_tracker_xyzw=exposure.icrf_from_star_tracker_xyzw,
        attitude_gap_s=exposure.attitude_gap_s,
        catalog_id=catalog.id[index][good],
        direction_icrf=prediction.direction_icrf[good],
        magnitude=catalog.magnitude[index][good].astype(np.float32),
        measured_px=centroids.xy_px[good],
        covariance_px2=centroids.covariance_px2[good] + np.outer(place_px2, [1.0, 0.0, 1.0]),
        flux_dn=centroids.flux_dn[good].astype(np.float32),
        snr=centroids.snr[good].astype(np.float32),
        refused_stars=dict(zip(names, counts.tolist(), strict=True)),
        refused_catalog_id=catalog.id[index][left_out],
        refused_px=prediction.xy_px[left_out].astype(np.float32),
        refused_reason=reason.astype(np.uint8),
        background_dn=model.background.level_dn,
        noise_dn=model.background.noise_dn,
        psf_sigma_px=model.psf_sigma_px,
        catalog_digest=catalog.digest,
        temperature_degc=exposure.temperature_degc,
        velocity_sigma_m_s=exposure.velocity.sigma_m_s,
        zenith_icrf=zenith_icrf,
        refraction_arcsec=refraction_arcsec,
    )


def realigned(geometry: CameraGeometry, observations: StarObservations) -> CameraGeometry:
    """
    Geometry with the alignment measured in an image, for the prediction of the next one.

    It avoids a second search of a whole image.  A refused image leaves the geometry unchanged.
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


def _check_catalog(
    prediction: Prediction, exposure: Exposure, geometry: CameraGeometry, search: StarSearch
) -> None:
    """
    Refuse an image where the catalog has too few stars for it.

    Raises ImageRefused ``not_in_catalog``, whose detail is the sky that the catalog must cover, or
    ``no_match`` for an image below the horizon of its site, where no star is predicted.
    """
    camera, count = geometry.camera, len(prediction.catalog_index)
    reach_px = search.reach_rad(camera)[0] * float(camera.parameters[0])
    in_field = count / window_area(camera, reach_px)
    if in_field >= _FEWEST_IN_FIELD or count > _NEAREST:
        return
    attitude = geometry.icrf_from_camera(exposure.icrf_from_star_tracker_xyzw)
    boresight = attitude.apply([[0.0, 0.0, 1.0]])
    zenith, _ = air_above(exposure.image.time_ns, exposure.site)
    if (boresight @ zenith < math.sin(math.radians(MIN_ELEVATION_DEG))).any():
        raise ImageRefused(
            'no_match',
            f'its attitude is below {MIN_ELEVATION_DEG:g} degrees of elevation at the site: check'
            ' latitude_deg, longitude_deg and the clock',
        )
    sky = sky_circle(boresight, field_radius_rad(camera, reach_px))
    limit = search.identification.magnitude_limit
    raise ImageRefused(
        'not_in_catalog',
        f'{in_field:.1f} catalog stars to V = {limit:g} in a field; needed: {sky}',
    )


def _find(
    pixels: Pixels,
    background: detection.Background,
    prediction: Prediction,
    search: StarSearch,
) -> tuple[Floats, detection.Sources, Streak | None]:
    """
    Predicted pixels (n, 2) corrected to match the sources, those sources, and their streaks.

    The brighter stars are searched near their predictions first; without a match, the whole image
    is searched over the full range of alignment errors.

    Raises ImageRefused ``no_stars``, ``smeared`` or ``no_match``.
    """
    camera = prediction.camera
    inside = in_image(prediction.xy_px, camera)
    near = detection.detect_near(
        pixels, background, prediction.xy_px[inside][:_NEAREST], SEARCH_RADIUS_PX
    )
    try:
        reach_px = float(SEARCH_RADIUS_PX)
        near, streak = without_streaks(pixels, background, near, camera)
        matched_px = acquire(prediction, near, reach_px, _NEAREST_ROLL_RAD)
        return matched_px, near, streak
    except ImageRefused:
        pass
    sources, streak = without_streaks(
        pixels, background, detection.detect(pixels, background), camera
    )
    if len(sources.snr) < _MIN_STARS:
        raise ImageRefused(
            'no_stars', f'{counted(len(sources.snr), "star-like source")}, {_MIN_STARS} needed'
        )
    tilt_rad, roll_rad = search.reach_rad(camera)
    reach_px = tilt_rad * float(camera.parameters[0])
    return acquire(prediction, sources, reach_px, roll_rad), sources, streak


def _refuse_displaced(prediction: Prediction, centroids: Centroids) -> NDArray[np.uint8]:
    """
    Refusal reasons (n,) of the centroids, with displaced stars as ``ambiguous``.

    Displacements are relative to a smooth correction fitted to the measured stars.
    """
    refusal = centroids.refusal.copy()
    good = np.nonzero(refusal == StarRefusal.NONE)[0]
    if len(good) < 4:
        return refusal
    expected_px, measured_px = prediction.xy_px[good], centroids.xy_px[good]
    sigma_px = centroids.sigma_px[good]
    half_px = 0.5 * prediction.camera.width
    correction, scatter_px = fit_warp(expected_px, measured_px, sigma_px, expected_px, half_px)
    off_px = np.hypot(*(measured_px - expected_px - correction).T)
    limit_px = np.maximum(5.0 * np.hypot(sigma_px, 0.75 * scatter_px), 0.3)
    refusal[good[off_px > np.minimum(limit_px, 2.0)]] = StarRefusal.AMBIGUOUS
    return refusal


def _refuse_line_loss(predicted_px: Floats, centroids: Centroids, shape: tuple[int, ...]) -> None:
    """
    Refuse an image with lost lines.

    Raises ImageRefused ``incomplete``.
    """
    reason = centroids.refusal
    good = (reason == StarRefusal.NONE) | (reason == StarRefusal.NOT_DETECTED)
    loss = find_line_loss(
        predicted_px[good], centroids.xy_px[good], centroids.sigma_px[good], shape
    )
    if loss is not None:
        row, (u, v) = loss
        detail = f'stars below row {row} are displaced by ({u:+.1f}, {v:+.1f}) px'
        raise ImageRefused('incomplete', detail)
