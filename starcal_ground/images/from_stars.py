# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Camera and attitudes of a set of images by their stars alone.

One image is searched over all focal lengths; the others with the camera that it gives.  A camera
common to all of them, fitted to the stars identified, then gives each its rotation.  The result
replaces a star tracker: the calibration that follows measures the images again, and takes nothing
from the rotations (method ``per_image``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ground.blind import search
from starcal_ground.blind.bright_sources import bright_sources, BrightSources
from starcal_ground.blind.images import FEWEST_SOURCES, ImageSearch
from starcal_ground.blind.search import Effort, SkyMatch
from starcal_ground.images import copies
from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import CameraModel, field_radius_rad, line_of_sight, project
from starcal_ros.camera.lens import ideal_points, LENSES
from starcal_ros.errors import NotFromStars
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import State
from starcal_ros.estimation.search import minimise, moved_to_stars, problem_of, start_of
from starcal_ros.estimation.star_equations import arrange, star_table
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import CameraGeometry, Ensemble, Image, StarObservations
from starcal_ros.sky.catalog import cone, StarCatalog
from starcal_ros.stars.frame_checks import fingerprint, sample_rows

ADVICE = 'take 20 frames over the whole sky, stars to the corners, 1 to 10 s each'
FEWEST_IMAGES = 3
# Half diagonals that are tried, degrees, the usual ones first: each is searched to 25 % of the
# focal length, and together they span fields of 5 to 120 degrees.  Up to 45 degrees
# an equidistant lens is found as a pinhole with distortion.
_PINHOLE, _EQUIDISTANT = 'plumb_bob', 'equidistant'
_HALF_FIELDS_DEG = (
    *((_PINHOLE, deg) for deg in (28.0, 20.0, 13.5, 38.0, 9.0, 50.0)),
    (_EQUIDISTANT, 52.0),
    *((_PINHOLE, deg) for deg in (6.0, 4.0, 2.7)),
)
_SEARCHED = 4  # images that are searched over all focal lengths
_MOST_EFFORT = 20_000  # limit of the first search: 100 to 200 s of processor time
_BRIEF_EFFORT = 500  # about 4 s: enough for seven of eight simulated cameras of 6 to 117 degrees
_CENTROID_PX = 0.3  # 1-sigma of the centroid of a bright source
_HOT_PIXEL_PX = 0.2  # extent of a source that is wider than one pixel
_BRIGHTEST, _LEAST_CONTRAST = 20, 2.0
_DETAIL_STEP_PX = 16  # 5,000 pixels of a megapixel give the range of its detail to 2 %
# The brightest unsaturated stars are compared with the catalog in brightness.
_MOST_OF_PEAK, _SAME_STAR_PX, _MOST_BRIGHT = 0.9, 2.0, 40
# Matches and residual of a lens that is better: up to 50 degrees both lenses have the same.
_MORE, _CLOSER = 1.1, 0.7
_ONE_LENS = 0.3  # tangent of a half diagonal to which the lenses are the same within a pixel
_OTHERS = 20, 80  # percentiles between which the focal lengths of one camera lie
_SAME_FOCAL = 0.1  # error of a data sheet that needs no word
_SAME_CAMERA = 0.02  # spread of the focal length over images of one lens and mode
_ROBUST_SCALE, _ROBUST_GAIN = 3.0, 0.1  # as in the first search of the estimate
_FREE_ARCSEC = 7200.0  # free rotations: at 20 arcsec those of single images bent the camera
_FEWEST_STARS, _MORE_STARS = 30, 1.02  # in all images; growth to match them again
_SIGMA_ARCSEC = 60.0  # 1-sigma of the rotations, more than refraction and aberration change them


@dataclass(frozen=True)
class FromStars:
    """
    Camera and rotations of images that were identified by their stars.

    ``camera`` is of the images mirrored left to right where they are ``mirrored``;
    ``icrf_from_camera`` by stamp; ``images`` is the number of different images, ``copies`` has
    words on each copy of one of them by its stamp; ``stated_px`` is the focal length of the
    nearest prior camera, NaN without one; ``other_focal_px`` has the focal lengths of images that
    match the sky with another camera and are left out.
    """

    camera: CameraModel
    mirrored: bool
    icrf_from_camera: Mapping[int, Rotation]
    images: int
    other_focal_px: tuple[float, ...] = ()
    copies: Mapping[int, str] = dataclasses.field(default_factory=dict)
    stated_px: float = math.nan

    def in_a_sentence(self) -> str:
        """Findings as a sentence for a person."""
        fx = float(self.camera.parameters[0])
        width, height = self.camera.width, self.camera.height
        u, v = (width - 1) / 2, (height - 1) / 2
        ends = np.array([[[-0.5, v], [width - 0.5, v]], [[u, -0.5], [u, height - 0.5]]])
        a, b = line_of_sight(self.camera, ends).transpose(1, 0, 2)
        across_deg = np.degrees(np.arccos((a * b).sum(axis=1)))
        field = ' x '.join(f'{deg:.1f}' for deg in across_deg)
        others = ', '.join(f'{focal_px:.0f}' for focal_px in self.other_focal_px)
        left_out = f'; left out, with another focal length: {others} px' if others else ''
        again = f'; left out: {len(self.copies)} copies' if self.copies else ''
        wrong = ''
        if abs(self.stated_px / fx - 1.0) > _SAME_FOCAL:
            wrong = f' (stated: {self.stated_px:.0f} px, which the stars contradict)'
        return (
            f'{len(self.icrf_from_camera)} of {self.images} images identified by their stars:'
            f' focal length {fx:.1f} px{wrong}, field {field} degrees{left_out}{again}'
        )


@dataclass(frozen=True)
class _RankedSources:
    """
    Sources of an image by their light: all, and the compact ones, without glare.

    ``stars`` counts those that may be stars; 0 in a picture of anything but the night sky.
    """

    time_ns: int
    rankings: tuple[Floats, Floats]
    stars: int


@one_blas_thread()
def from_stars(
    images: Iterable[Image],
    catalog: StarCatalog,
    priors: Sequence[CameraModel] = (),
    min_images: int = FEWEST_IMAGES,
    too_few: str = '',
) -> FromStars:
    """
    The camera and the rotations of images; one of ``priors``, if any, is good to 25 %.

    ``too_few`` says why no prior can match, or is empty; then only other fields are searched, and
    briefly, since what is stated may be wrong.

    Raises NotFromStars when the images give no camera; the text says what to photograph.
    """
    seen, size, found = _sources(images)
    if len(seen) < min_images:
        words = next(iter(found.values()), '')
        again = f' ({len(found)} more are copies, the first since {words})' if found else ''
        plural = 's' * (len(seen) != 1)
        raise NotFromStars(
            f'{len(seen)} different image{plural}{again}, {min_images} are needed: {ADVICE}'
        )
    rich = [one for one in seen if one.stars >= FEWEST_SOURCES]
    if not rich:
        counts = [one.stars for one in seen]
        raise NotFromStars(
            f'no stars: {int(np.median(counts))} star-like sources in an image; {ADVICE}, and'
            ' focus at infinity'
        )
    half_px = 0.5 * math.hypot(*size)
    usual = (_usual(size, half_px, model, math.radians(deg)) for model, deg in _HALF_FIELDS_DEG)
    first = _first_match(rich, priors, catalog) if priors and not too_few else None
    first = first or _first_match(
        rich, list(usual), catalog, _BRIEF_EFFORT if too_few else _MOST_EFFORT
    )
    if first is None and too_few:
        raise NotFromStars(too_few)
    if first is None:
        given = ''.join(f'{float(one.parameters[0]):.0f} px or ' for one in priors)
        raise NotFromStars(
            f'the stars of {len(seen)} images match no part of the sky of the catalog, with'
            f' {given}fields of 5 to 120 degrees: {ADVICE}; a tripod or a still spacecraft, no'
            ' clouds, no lights; fields under 3 degrees need their focal length and a catalog of'
            ' their region (starcal catalog)'
        )
    matches, other_focal_px = _of_one_lens(_all_matches(rich, *first))
    if len(matches) < min_images:
        raise NotFromStars(
            f'{len(matches)} of {len(seen)} images match the sky, {min_images} are needed:'
            f' {ADVICE}; no clouds, no lights, no frames of anything else'
        )
    sources = {one.time_ns: one.rankings[0] for one in rich}
    camera, rotations = _common_camera(matches, sources, catalog)
    stated_px = min(
        (float(one.parameters[0]) for one in priors),
        key=lambda one_px: abs(math.log(one_px / float(camera.parameters[0]))),
        default=math.nan,
    )
    (mirrored,) = first[0].mirrored
    return FromStars(camera, mirrored, rotations, len(seen), other_focal_px, found, stated_px)


def _sources(
    images: Iterable[Image],
) -> tuple[list[_RankedSources], tuple[int, int], dict[int, str]]:
    """Sources of the images that differ, their size, and words on each copy by its stamp."""
    seen: list[_RankedSources] = []
    size = (0, 0)
    first_ns: dict[str, int] = {}
    exposures: list[copies.Fingerprint] = []
    found: dict[int, str] = {}
    for image in images:
        height, width = image.pixels.shape
        if size == (0, 0):
            size = (width, height)
        if size != (width, height):
            raise NotFromStars(
                f'images of {size[0]} x {size[1]} and of {width} x {height}: give those of one'
                ' camera and mode'
            )
        digest = fingerprint(image, sample_rows(image.pixels)).digest
        if digest in first_ns:
            found[image.time_ns] = copies.equal_to(first_ns[digest])
            continue
        first_ns[digest] = image.time_ns
        sources = bright_sources(image.pixels)
        is_star = sources.wide_px > _HOT_PIXEL_PX
        noise = copies.noise_of(image.pixels)
        exposures.append(copies.Fingerprint(image.time_ns, sources.xy_px[is_star], noise))
        stars = count_of_stars(image.pixels, sources)
        seen.append(_RankedSources(image.time_ns, sources.rankings, stars))
    found |= copies.encoded_again(exposures)
    return [one for one in seen if one.time_ns not in found], size, found


def count_of_stars(pixels: Pixels, sources: BrightSources) -> int:
    """Number of sources of an image that may be stars; 0 of anything but the night sky."""
    height, width = pixels.shape
    step = _DETAIL_STEP_PX
    places = np.stack(np.meshgrid(np.arange(0, width, step), np.arange(0, height, step)), axis=-1)
    level_dn = sources.background.level_at(places.reshape(-1, 2))
    # The sky of a star camera by day is bright and uneven, but smooth.
    low, high = np.percentile(pixels[::step, ::step].ravel() - level_dn, [10, 90])
    brightest = np.rint(sources.xy_px[:_BRIGHTEST]).astype(np.int64)
    peaks_dn = sources.peak_dn[:_BRIGHTEST] - sources.background.level_at(brightest)
    # In a picture of anything by day or by lamps, peaks are hardly above the rest of its detail.
    if not len(peaks_dn) or np.median(peaks_dn) < _LEAST_CONTRAST * (high - low):
        return 0
    return int(np.count_nonzero(sources.wide_px > _HOT_PIXEL_PX))


def brightness_errors_mag(image: Image, stars: FromStars, catalog: StarCatalog) -> Floats:
    """Magnitudes (n,) of the brightest sources less those of the catalog, about their median."""
    sources = bright_sources(image.pixels)
    unsaturated = sources.peak_dn < _MOST_OF_PEAK * float(image.pixels.max())
    # Half of the light of faint ones is below the noise, and their neighbours add theirs.
    bright = np.flatnonzero(unsaturated)[:_MOST_BRIGHT]
    xy_px = sources.xy_px[bright]
    rotation = stars.icrf_from_camera[image.time_ns]
    axis = rotation.apply([0.0, 0.0, 1.0])
    rows = cone(catalog, axis, field_radius_rad(stars.camera))
    seen_px = project(stars.camera, rotation.inv().apply(catalog.direction_icrs[rows]))
    in_front = np.isfinite(seen_px).all(axis=1)
    rows, seen_px = rows[in_front], seen_px[in_front]
    if not (len(xy_px) and len(rows)):
        return np.empty(0)
    distance_px, nearest = cKDTree(seen_px).query(xy_px)
    near = distance_px < _SAME_STAR_PX
    error = -2.5 * np.log10(sources.flux_dn[bright][near])
    error -= catalog.magnitude[rows[nearest[near]]]
    return np.asarray(error - np.median(error) if len(error) else error)


def ideal_camera(size: tuple[int, int], focal_px: float, model: str = _PINHOLE) -> CameraModel:
    """A camera of this size (width, height) without distortion, its axis in the middle."""
    middle = (size[0] - 1) / 2, (size[1] - 1) / 2
    none = np.zeros(len(LENSES[model].coefficients))
    return CameraModel(*size, np.array([focal_px, 0.0, focal_px, *middle, *none]), model)


def _usual(size: tuple[int, int], half_px: float, model: str, half_rad: float) -> CameraModel:
    """A camera of a model without distortion, of this half diagonal."""
    towards = np.array([math.sin(half_rad), 0.0, math.cos(half_rad)])
    return ideal_camera(size, half_px / float(ideal_points(model, towards)[0]), model)


def _first_match(
    seen: Sequence[_RankedSources],
    cameras: Sequence[CameraModel],
    catalog: StarCatalog,
    most: float = _MOST_EFFORT,
) -> tuple[ImageSearch, Rotation] | None:
    """The search that one of the cameras has identified an image for, and its rotation."""
    effort = Effort(most)
    ordered = sorted(seen, key=lambda one: -one.stars)
    half = ordered[: max(1, (len(ordered) + 1) // 2)]
    for one in half[:: max(1, len(half) // _SEARCHED)][:_SEARCHED]:
        sky, ranking = search.find_in_any(
            one.rankings, cameras, catalog, (False, True), search.ROUNDS[:1], effort
        )
        if sky:
            better = _of_better_lens(sky, one.rankings[ranking], catalog)
            found = ImageSearch(better.camera, catalog)
            found.take(better, ranking)
            return found, better.camera_from_icrf
        if effort.is_spent:
            break
    return None


def _of_better_lens(sky: SkyMatch, xy_px: Floats, catalog: StarCatalog) -> SkyMatch:
    """A match of sources (n, 2), or the same with an equidistant lens where that shows more."""
    corner = (
        0.5 * math.hypot(sky.camera.width, sky.camera.height) / float(sky.camera.parameters[0])
    )
    if sky.camera.lens.is_angular or corner < _ONE_LENS:
        return sky
    # Without distortion: coefficients fitted to a perspective lens bend corners without stars.
    size, focal_px = (sky.camera.width, sky.camera.height), _focal_px(sky.camera, _EQUIDISTANT)
    camera = ideal_camera(size, focal_px, _EQUIDISTANT)
    cx, cy = sky.camera.parameters[3:5].tolist()
    camera = camera.replace(cx=cx, cy=cy)
    if sky.mirrored:
        camera = search.mirrored_camera(camera)
    other = search.confirm_sky(xy_px, camera, catalog, sky.camera_from_icrf, sky.mirrored)
    if other and (
        len(other.xy_px) > _MORE * len(sky.xy_px) or other.residual_px < _CLOSER * sky.residual_px
    ):
        return other
    return sky


def _all_matches(
    seen: Sequence[_RankedSources], finder: ImageSearch, rotation: Rotation
) -> dict[int, SkyMatch]:
    """The images that the camera of the first match, of this rotation, identifies, by stamp."""
    matches: dict[int, SkyMatch] = {}
    for one in seen:
        if sky := finder.guess(one.rankings, [rotation]) or finder.look_up(one.rankings):
            matches[one.time_ns], rotation = sky, sky.camera_from_icrf
    return matches


def _of_one_lens(
    matches: Mapping[int, SkyMatch],
) -> tuple[dict[int, SkyMatch], tuple[float, ...]]:
    """
    The matches with the focal length of most, and the focal lengths of the others.

    A few others are false, of another lens, or pictures of a screen that shows the sky.
    """
    if not matches:
        return {}, ()
    focal_px = np.array([_focal_px(sky.camera, sky.camera.model) for sky in matches.values()])
    low, high = np.percentile(focal_px, _OTHERS)
    if high > (1 + _SAME_CAMERA) * low:
        raise NotFromStars(
            f'focal lengths of {low:.0f} to {high:.0f} px: several lenses, a zoom or a change of'
            f' focus; with one lens, its zoom and focus fixed, {ADVICE}'
        )
    alike = np.abs(focal_px / np.median(focal_px) - 1) < _SAME_CAMERA
    kept = {t: sky for (t, sky), same in zip(matches.items(), alike, strict=True) if same}
    return kept, tuple(focal_px[~alike].tolist())


def _focal_px(camera: CameraModel, model: str) -> float:
    """
    Focal length of a lens model at the RMS radius of the detector.

    There it hardly trades with the distortion, which in the middle it does from image to image.
    """
    radius_px = math.hypot(camera.width, camera.height) / math.sqrt(12.0)
    from_middle_px = radius_px * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    directions = line_of_sight(camera, camera.parameters[3:5] + from_middle_px)
    ideal = ideal_points(model, directions)
    return float(np.mean(radius_px / np.linalg.norm(ideal, axis=1)))


def _common_camera(
    matches: dict[int, SkyMatch], sources: Mapping[int, Floats], catalog: StarCatalog
) -> tuple[CameraModel, dict[int, Rotation]]:
    """
    The camera that fits all matches, and the rotations ``icrf_from_camera`` with it.

    The camera of one image is wrong where that shows no stars: ``sources`` (n, 2) by stamp are
    matched again with that of all, until it matches no more of them.
    """
    parameters = np.median([sky.camera.parameters for sky in matches.values()], axis=0)
    camera = dataclasses.replace(next(iter(matches.values())).camera, parameters=parameters)
    stars = 0
    while len(matches) > 1:
        before, stars = stars, sum(len(sky.xy_px) for sky in matches.values())
        if stars < max(_FEWEST_STARS, _MORE_STARS * before):
            break
        images = tuple(_observations(*one, catalog, camera) for one in matches.items())
        state = _robust_search(images, camera)
        camera = dataclasses.replace(camera, parameters=state.parameters)
        matches = {
            t: search.matched_again(sky, sources[t], catalog, camera, rotation)
            for (t, sky), rotation in zip(matches.items(), state.camera_from_icrf, strict=True)
        }
    return camera, {t: sky.camera_from_icrf.inv() for t, sky in matches.items()}


def _robust_search(images: tuple[StarObservations, ...], camera: CameraModel) -> State:
    """Camera and rotations that fit images, without the variances and sigmas of an estimate."""
    options = CalibrationOptions(method='per_image', star_tracker_sigma_arcsec=(_FREE_ARCSEC,) * 3)
    geometry = CameraGeometry(camera, np.array([0.0, 0.0, 0.0, 1.0]))
    table, problem = star_table(images), problem_of(Ensemble(images), geometry, options)
    start = moved_to_stars(problem, start_of(problem, geometry, 0, False), table, camera)
    measurements = arrange(table, np.ones(len(table), bool), table.covariance_px2)
    try:
        return minimise(problem, start, measurements, _ROBUST_SCALE, _ROBUST_GAIN).state
    except NotObservable:
        return start


def _observations(
    time_ns: int, sky: SkyMatch, catalog: StarCatalog, camera: CameraModel
) -> StarObservations:
    """Identified sources as observations of stars; their attitude is that of the camera."""
    rows, n = sky.catalog_index, len(sky.catalog_index)
    return StarObservations.of_image(
        time_ns,
        (camera.width, camera.height),
        icrf_from_star_tracker_xyzw=sky.camera_from_icrf.inv().as_quat(),
        catalog_id=catalog.id[rows],
        direction_icrf=catalog.direction_icrs[rows],
        magnitude=catalog.magnitude[rows].astype(np.float32),
        measured_px=sky.camera_px,
        covariance_px2=np.tile([_CENTROID_PX**2, 0.0, _CENTROID_PX**2], (n, 1)),
        flux_dn=np.full(n, np.nan, np.float32),
        snr=np.full(n, np.nan, np.float32),
    )


def options_of(values: Mapping[str, object]) -> dict[str, object]:
    """Options of a calibration whose attitudes are those of `from_stars`."""
    others = ('more_star_trackers', 'more_alignments')
    return {
        **{name: value for name, value in values.items() if name not in others},
        'method': 'per_image',
        'star_tracker_sigma_arcsec': (_SIGMA_ARCSEC,) * 3,
        'prior_alignment_sigma_deg': _SIGMA_ARCSEC / 3600.0,
        'star_tracker_frame': '',
        'attitude_direction': 'st_to_inertial',
        'stamp_offset_s': 0.0,
        # Rotations of single images have no rate, with which read-out and stamps are estimated.
        'shutter': 'global',
        'stamp_sigma_s': 0.0,
    }
