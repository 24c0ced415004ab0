"""
The stars of one image: predicted, found, and each measured in its own window.

Sources next to the predictions place the prediction, or those of the whole image where launch has
turned the camera (`acquisition`); what is measured is freed from the light of its neighbours
(`blends`), and stars off the place that the others give them are refused.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import line_of_sight
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.acquisition import acquire
from starcal_ros.identification.blending import separate
from starcal_ros.identification.line_loss import find_tear
from starcal_ros.identification.photometric_check import refuse_unlike
from starcal_ros.identification.polynomial_warp import fit_warp
from starcal_ros.identification.prediction import (
    in_image,
    predict,
    Prediction,
    SPACE,
    within_image,
)
from starcal_ros.image.centroiding import (
    CentroidOptions,
    Centroids,
    ImageModel,
    measure_stars,
    model_image,
)
from starcal_ros.image.detection import (
    Background,
    detect,
    detect_near,
    measure_background,
    Sources,
)
from starcal_ros.image.hot_pixels import NO_HOT_PIXELS, refuse_on_hot_pixels
from starcal_ros.image.psf_field import Instrument, learn, MeasuredStars
from starcal_ros.image.psf_fit import stamp_radius_px
from starcal_ros.options import option
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.catalog import StarCatalog

_TRACKED = 200  # brightest predictions that are looked for in windows of their own
_TRACKED_ROLL_RAD = 0.01  # a star tracker is off by less about any axis once aligned


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
        3.0,
        'largest error left of the pull of catalog neighbours on a centroid, in its sigma',
        low=0.0,
        high=100.0,
    )
    max_brightness_scatter_mag: float = option(
        0.75,
        'largest scatter of the brightnesses of the stars about those of the catalog, mag, that is'
        ' no chance match; more for a camera whose band is far from V, 100 not to ask',
        low=0.3,
        high=100.0,
    )


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
    temperature_degc: float = math.nan


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
        ``no_stars``, ``no_match`` or ``incomplete``.
    """
    image = shot.image
    background = measure_background(image.pixels)
    prediction = predict(
        geometry,
        shot.icrf_from_star_tracker_xyzw,
        image.time_ns,
        catalog,
        options.magnitude_limit,
        math.radians(options.acquisition_radius_deg),
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

    Raises
    ------
    ImageRefused
        ``incomplete`` where the stars show that some rows were lost, ``no_match`` where they are
        not as bright as those of the catalog.
    """
    height, width = shot.image.pixels.shape
    shown = within_image(prediction, width, height)
    centroids = measure_stars(
        shot.image.pixels, shown.xy_px, model, centroid_options, shot.hot_pixels
    )
    centroids, alone = separate(shown, catalog, centroids, model, options.max_blend_sigma)
    _refuse_torn(shown.xy_px, centroids, (height, width))
    psf_sigma_px = model.psf_sigma_px or 1.0
    refusal = refuse_on_hot_pixels(
        shown.xy_px,
        _refuse_displaced(shown.xy_px, centroids, width),
        shot.hot_pixels,
        width,
        stamp_radius_px(psf_sigma_px),
        psf_sigma_px,
    )
    magnitude = catalog.magnitude[shown.catalog_index]
    centroids = dataclasses.replace(centroids, refusal=refusal)
    refusal = refuse_unlike(
        magnitude,
        shown.xy_px,
        centroids,
        model,
        centroid_options.min_snr,
        options.max_brightness_scatter_mag,
        (height, width),
    )
    centroids = dataclasses.replace(centroids, refusal=refusal)
    observations = _observations(
        shot, shown, catalog, centroids, model, options.min_stars_per_image
    )
    if observations.refusal or centroids.fit is None:
        return observations, instrument
    stars = MeasuredStars(
        centroids.xy_px,
        centroids.fit,
        centroids.psf_sigma_px,
        centroids.noise_dn,
        (refusal == '') & alone,
    )
    shown_dn = model.saturation_dn if np.isfinite(model.saturation_dn) else 0.0
    return observations, learn(instrument, stars, model.pixel_noise, shown_dn, (width, height))


def _observations(
    shot: Shot,
    prediction: Prediction,
    catalog: StarCatalog,
    centroids: Centroids,
    model: ImageModel,
    fewest: int,
) -> StarObservations:
    """What is said of an image: its stars and those left out; with too few, that it is refused."""
    height, width = shot.image.pixels.shape
    index = prediction.catalog_index
    good = centroids.refusal == ''
    left_out = ~good
    names, code, counts = np.unique(
        centroids.refusal[left_out], return_inverse=True, return_counts=True
    )
    measured = np.count_nonzero(good)
    few = measured < fewest
    if few:
        good = np.zeros_like(good)
    return StarObservations(
        time_ns=shot.image.time_ns,
        width=width,
        height=height,
        refusal='too_few_stars' if few else '',
        detail=f'{measured} stars measured well, {fewest} needed' if few else '',
        icrf_from_star_tracker_xyzw=shot.icrf_from_star_tracker_xyzw,
        attitude_gap_s=shot.attitude_gap_s,
        catalog_id=catalog.id[index][good],
        direction_icrf=prediction.direction_icrf[good],
        magnitude=catalog.magnitude[index][good].astype(np.float32),
        measured_px=centroids.xy_px[good],
        covariance_px2=centroids.covariance_px2[good],
        flux_dn=centroids.flux_dn[good].astype(np.float32),
        snr=centroids.snr[good].astype(np.float32),
        refused_stars=dict(zip(names.tolist(), counts.tolist(), strict=True)),
        refused_catalog_id=catalog.id[index][left_out],
        refused_px=prediction.xy_px[left_out].astype(np.float32),
        refused_reason=code.astype(np.uint8),
        background_dn=model.background.level_dn,
        noise_dn=model.background.noise_dn,
        psf_sigma_px=model.psf_sigma_px,
        catalog_digest=catalog.digest,
        temperature_degc=shot.temperature_degc,
    )


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
    inside = in_image(prediction.xy_px, camera.width, camera.height)
    near = detect_near(
        pixels,
        background,
        prediction.xy_px[inside][:_TRACKED],
        options.search_radius_px,
        centroid_options.detection_sigma,
    )
    try:
        reach_px = float(options.search_radius_px)
        return acquire(prediction, near, geometry, reach_px, _TRACKED_ROLL_RAD), near
    except ImageRefused:
        pass
    sources = detect(pixels, background, centroid_options.detection_sigma)
    if len(sources.snr) < 4:
        raise ImageRefused('no_stars', f'{len(sources.snr)} star-like sources')
    reach_px = math.radians(options.acquisition_radius_deg) * float(camera.parameters[0])
    roll_rad = math.radians(options.acquisition_roll_deg)
    return acquire(prediction, sources, geometry, reach_px, roll_rad), sources


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
    expected_px, measured_px = predicted_px[good], centroids.xy_px[good]
    correction, scatter_px = fit_warp(
        expected_px, measured_px, sigma_px[good], expected_px, 0.5 * width
    )
    off_px = np.hypot(*(measured_px - expected_px - correction).T)
    limit_px = np.maximum(5.0 * np.hypot(sigma_px[good], 0.75 * scatter_px), 0.3)
    refusal[good[off_px > np.minimum(limit_px, 2.0)]] = 'ambiguous'
    return refusal


def _refuse_torn(predicted_px: Floats, centroids: Centroids, shape: tuple[int, int]) -> None:
    """
    Refuse a frame whose stars jump at some row against their predictions (n, 2).

    Raises
    ------
    ImageRefused
        ``incomplete``.
    """
    good = np.isin(centroids.refusal, ('', 'not_detected'))
    variance_px2 = 0.5 * (centroids.covariance_px2[good, 0] + centroids.covariance_px2[good, 2])
    tear = find_tear(predicted_px[good], centroids.xy_px[good], np.sqrt(variance_px2), shape)
    if tear is not None:
        u, v = tear.off_px
        detail = f'below row {tear.row} the stars stand ({u:+.1f}, {v:+.1f}) px from their places'
        raise ImageRefused('incomplete', detail)
