# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations of an image sequence; each image is predicted from the previous ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
import math

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ImageRefused
from starcal_ros.estimation.options import assumed_tracker_sigma_rad
from starcal_ros.identification.star_finder import Exposure, observe_stars, realigned
from starcal_ros.identification.tracking import start_tracking, track_stars, TrackedCamera
from starcal_ros.pipeline.setup import Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import CameraGeometry, Image, refused_image, StarObservations
from starcal_ros.sky.astrometry import velocity_of
from starcal_ros.sky.attitude import Attitude, AttitudeHistory, attitudes_at
from starcal_ros.stars.frame_checks import Fingerprint, fingerprint, sample_rows, screen
from starcal_ros.stars.hot_pixels import HotPixels, learn_hot_pixels
from starcal_ros.stars.image_model import saturation_level

_SAME_ATTITUDE = 1e-12  # difference of a component; interpolation of equal samples rounds at 1e-16
_TURN_SIGMAS = 2.0  # a coarse star tracker may repeat its output within its noise
_TURN_PX = 0.1  # noise of the turn between two images, of their centroids and the prior camera
_IMAGES_OF_A_RESTART = 3  # two images may be swapped in transit, three are not
_IMAGES_OF_AN_UNFIT = 10  # cost of an unfit attitude: its search takes as long as five images


@dataclasses.dataclass(frozen=True)
class Unfit:
    """Number of images for which a star tracker's attitude was unfit, and the last reason."""

    images: int = 0
    why: str = ''  # empty: its attitude was used since


@dataclasses.dataclass(frozen=True)
class Track:
    """
    State of an image sequence.

    ``geometry`` predicts the stars of a searched image; ``latest_ns`` is the stamp of the last
    image used.  ``tracked_camera`` measures the next image without a search; None before the first
    image.  ``behind`` counts images in a row with stamps before the last one used, ``behind_ns``
    is the stamp of the latest of them.  ``seen`` is the previous frame, used or not, which a stuck
    camera repeats; ``hot`` are the hot pixels detected so far.
    ``first_with_same_attitude`` is the first image of the current run of bit-identical attitudes
    of images used.  ``taken`` counts the images of each star tracker;
    ``others`` holds a state for each additional one, because mountings are not exact.  ``unfit``
    lists star trackers whose attitude was refused while another one was accepted.
    """

    geometry: CameraGeometry
    latest_ns: int | None = None
    tracked_camera: TrackedCamera | None = None
    behind: int = 0
    behind_ns: int = 0
    seen: Fingerprint | None = None
    hot: HotPixels | None = None
    first_with_same_attitude: StarObservations | None = None
    taken: Mapping[str, int] = dataclasses.field(default_factory=dict)
    unfit: Mapping[str, Unfit] = dataclasses.field(default_factory=dict)
    others: Mapping[str, Track] = dataclasses.field(default_factory=dict)


@one_blas_thread()
def observe_next(
    image: Image,
    attitudes: AttitudeHistory,
    setup: Setup,
    track: Track | None = None,
    velocity_m_s: Floats | None = None,
    temperature_degc: float = math.nan,
    more_attitudes: Sequence[AttitudeHistory] = (),
) -> tuple[StarObservations, Track]:
    """
    Observations of the next image of a sequence, and the state of the sequence after it.

    Without a ``track`` the image is the first, and the prior predicts its stars.
    ``velocity_m_s`` (3,) is the observer's barycentric velocity, ICRF axes; None: that of the
    options, else the Earth's.
    ``more_attitudes`` belong to the additional star trackers of the setup.  The star tracker with
    the fewest images is tried first; if its attitude leads to a refusal, the next one is tried.
    ``detail`` records that refusal, and the star tracker is then tried less often.

    A sequence starts with the prior or the active calibration.  An image stamped at or before the
    last one used is refused and does not change the state, so that one wrong stamp costs one
    image.  After the third such image in a row, in order among themselves, the sequence restarts
    with that image: a clock was set back, or a recording is played again.  An image that repeats
    the pixels of the previous image, used or not, with another stamp is refused.
    """
    track = _after_order(track or Track(setup.prior), image.time_ns)
    velocity = velocity_of(setup.site, velocity_m_s)
    known: dict[str, object] = {
        'temperature_degc': temperature_degc,
        'velocity_sigma_m_s': velocity.sigma_m_s,
    }
    remembered = track
    try:
        check_order(image, track.latest_ns)
        _check_size(image, track.geometry.camera)
        sample = sample_rows(image.pixels)
        seen = fingerprint(image, sample)
        remembered = dataclasses.replace(track, seen=seen)
        known['pixel_digest'] = seen.digest
        found = attitudes_at(
            image.time_ns,
            attitudes,
            more_attitudes,
            setup.mountings[: len(more_attitudes)],
            setup.attitude.max_attitude_gap_s,
            track.taken,
            assumed_tracker_sigma_rad(setup.calibration),
        )
        known |= vars(found[0]) | {'catalog_digest': setup.catalog.digest}
        saturation_dn = setup.centroid.saturation_dn
        screen(sample, seen, track.seen, saturation_dn, setup.dark, setup.screening)
        hot = (track.hot or setup.hot).index
        exposure = Exposure(
            flattened(_without_dark(image, setup), setup.flat, setup.dark_pedestal_dn),
            found[0].icrf_from_star_tracker_xyzw,
            found[0].attitude_gap_s,
            velocity,
            setup.site,
            hot,
            temperature_degc,
        )
        observations, after = _with_any(found, exposure, setup, remembered)
        return dataclasses.replace(observations, pixel_digest=seen.digest), after
    except ImageRefused as refused:
        height, width = image.pixels.shape
        observations = refused_image(
            image.time_ns, width, height, refused.reason, refused.detail, **known
        )
        return observations, remembered


def _with_any(
    attitudes: Sequence[Attitude], exposure: Exposure, setup: Setup, track: Track
) -> tuple[StarObservations, Track]:
    """Observations with the first attitude that leads to no refusal, else the first refusal."""
    refused_by_stars: list[tuple[StarObservations, Track]] = []
    errors: list[ImageRefused] = []
    unfit: dict[str, str] = {}
    for attitude in attitudes:
        try:
            observations, after = _with_one(attitude, exposure, setup, track)
        except ImageRefused as refused:
            errors.append(refused)
            why = f'{refused.reason}: {refused.detail}'
        else:
            if not observations.refusal:
                detail = '; '.join(unfit.values())
                observations = dataclasses.replace(observations, detail=detail)
                return observations, _with_fitness(after, attitude.star_tracker, unfit)
            refused_by_stars.append((observations, after))
            why = f'{observations.refusal}: {observations.detail}'
        label = attitude.star_tracker or setup.frames.star_tracker_frame
        unfit[attitude.star_tracker] = f'{label} not used: {why}'
    if not refused_by_stars:
        raise errors[0]
    return refused_by_stars[0]


def _with_fitness(track: Track, used: str, unfit: Mapping[str, str]) -> Track:
    """State after an image for which one star tracker was used and others were unfit."""
    taken, known = dict(track.taken), dict(track.unfit)
    if used in known:
        known[used] = dataclasses.replace(known[used], why='')
    for name, why in unfit.items():
        taken[name] = taken.get(name, 0) + _IMAGES_OF_AN_UNFIT
        known[name] = Unfit(known.get(name, Unfit()).images + 1, why)
    return dataclasses.replace(track, taken=taken, unfit=known)


def _with_one(
    attitude: Attitude, exposure: Exposure, setup: Setup, track: Track
) -> tuple[StarObservations, Track]:
    """Observations with an attitude; the new state updates that star tracker only."""
    name = attitude.star_tracker
    # The error of the mounting exceeds the uncertainty of a tracked camera.
    own = track.others.get(name, Track(track.geometry)) if name else track
    before = dataclasses.replace(
        track,
        geometry=own.geometry,
        tracked_camera=own.tracked_camera,
        first_with_same_attitude=own.first_with_same_attitude,
    )
    exposure = dataclasses.replace(
        exposure,
        icrf_from_star_tracker_xyzw=attitude.icrf_from_star_tracker_xyzw,
        attitude_gap_s=attitude.attitude_gap_s,
    )
    observations, after = _stars(exposure, setup, before)
    observations = dataclasses.replace(observations, **vars(attitude))
    if observations.refusal:
        return observations, track
    first = _first_with_same_attitude(observations, before.first_with_same_attitude, setup)
    after = dataclasses.replace(after, first_with_same_attitude=first)
    taken = {**track.taken, name: track.taken.get(name, 0) + 1}
    if not name:
        return observations, dataclasses.replace(after, taken=taken)
    return observations, dataclasses.replace(
        track,
        latest_ns=after.latest_ns,
        hot=after.hot,
        taken=taken,
        others={**track.others, name: dataclasses.replace(after, others={})},
    )


def _without_dark(image: Image, setup: Setup) -> Image:
    """Image minus dark frame, kept positive by adding the median of the dark frame."""
    pixels, dark = image.pixels, setup.dark
    if dark is None:
        return image
    if dark.dtype != pixels.dtype:
        raise ImageRefused('bad_encoding', f'{pixels.dtype} image, the dark frame is {dark.dtype}')
    # Clipping noise below the dark level at zero would bias the background.
    below = np.minimum(dark, dark.dtype.type(setup.dark_pedestal_dn))
    raised = cv2.add(pixels, dark.dtype.type(setup.dark_pedestal_dn) - below)
    # OpenCV's type stubs lack integer images.
    level: Pixels = cv2.subtract(raised, dark - below)  # type: ignore[assignment]
    # Saturated pixels stay at the end of the range, so that they are still found.
    peak = int(pixels.max())
    level[(level > peak) | (pixels >= (saturation_level(pixels, setup.centroid) or np.inf))] = peak
    return Image(image.time_ns, level)


def flattened(image: Image, flat: Floats | None, pedestal_dn: int) -> Image:
    """
    Image divided by the flat field above a pedestal; of blind pixels as it is.

    The brightest pixels stay at the peak of the image, so that saturated ones are still found.
    """
    if flat is None:
        return image
    pixels = image.pixels
    peak = int(pixels.max())
    signal = (pixels.astype(np.float32) - pedestal_dn) / np.nan_to_num(flat, nan=1.0)
    level = np.clip(np.rint(signal + pedestal_dn), 0, peak)
    level[pixels == peak] = peak
    cast = level.astype(np.uint8) if pixels.dtype == np.uint8 else level.astype(np.uint16)
    return Image(image.time_ns, cast)


def _after_order(track: Track, time_ns: int) -> Track:
    """State when an image arrives; the third image from the past restarts the sequence."""
    if track.latest_ns is None or time_ns > track.latest_ns:
        return dataclasses.replace(track, behind=0)
    behind = track.behind + 1 if track.behind and time_ns > track.behind_ns else 1
    if behind < _IMAGES_OF_A_RESTART:
        return dataclasses.replace(track, behind=behind, behind_ns=time_ns)
    return Track(track.geometry, hot=track.hot, unfit=track.unfit)


def _stars(exposure: Exposure, setup: Setup, track: Track) -> tuple[StarObservations, Track]:
    """Stars of an image by the track of the images before it, or else by a search."""
    if track.tracked_camera is not None:
        with contextlib.suppress(ImageRefused):  # the full search finds the reason of refusal
            observations, tracked_camera = track_stars(
                exposure, track.tracked_camera, setup.star_search
            )
            after = dataclasses.replace(track, tracked_camera=tracked_camera)
            return observations, _after_image(after, exposure, observations, setup)
    observations, instrument = observe_stars(exposure, track.geometry, setup.star_search)
    if observations.refusal:
        return observations, track
    geometry = realigned(track.geometry, observations)
    started = start_tracking(geometry, observations, instrument)
    after = dataclasses.replace(track, geometry=geometry, tracked_camera=started)
    return observations, _after_image(after, exposure, observations, setup)


def _first_with_same_attitude(
    observations: StarObservations, first: StarObservations | None, setup: Setup
) -> StarObservations:
    """
    First image with the attitude of this image; ``first`` is that of the previous image.

    Raises ImageRefused ``frozen_attitude`` if the attitude equals that of ``first`` to the last
    digit, which a working star tracker's noise rules out, and the stars have turned by more than
    its sigma.
    """
    attitude = observations.icrf_from_star_tracker_xyzw
    if first is None:
        return observations
    difference = attitude - first.icrf_from_star_tracker_xyzw
    if np.abs(difference).max() > _SAME_ATTITUDE:
        return observations
    # Comparable, since both use the prior camera.
    before, now = (
        Rotation.from_quat(realigned(setup.prior, image).star_tracker_from_camera_xyzw)
        for image in (first, observations)
    )
    turn = np.abs((before.inv() * now).as_rotvec())
    across_rad, around_rad = float(np.hypot(turn[0], turn[1])), float(turn[2])
    camera = setup.prior.camera
    noise_rad = _TURN_PX / camera.parameters[0]
    direction = line_of_sight(camera, observations.measured_px)
    radius = float(np.sqrt(np.nanmean(direction[:, 0] ** 2 + direction[:, 1] ** 2)))
    sigma_rad = float(assumed_tracker_sigma_rad(setup.calibration).max())
    limit_rad = _TURN_SIGMAS * sigma_rad + noise_rad
    limit_around_rad = _TURN_SIGMAS * sigma_rad + noise_rad / max(radius, noise_rad)
    if across_rad > limit_rad or around_rad > limit_around_rad:
        turned_arcsec = max(across_rad, around_rad) / ARCSECOND_RAD
        raise ImageRefused(
            'frozen_attitude',
            f'one attitude, but the stars have turned {turned_arcsec:.0f} arcsec',
        )
    return first


def _after_image(
    track: Track, exposure: Exposure, observations: StarObservations, setup: Setup
) -> Track:
    """Track with the stamp and the hot pixels of an image, by the alignment of the track."""
    hot = learn_hot_pixels(
        track.hot or setup.hot,
        exposure.image.pixels,
        observations.background_dn,
        observations.noise_dn,
        track.geometry.icrf_from_camera(exposure.icrf_from_star_tracker_xyzw),
        float(track.geometry.camera.parameters[0]),
    )
    return dataclasses.replace(track, latest_ns=exposure.image.time_ns, hot=hot)


def _check_size(image: Image, camera: CameraModel) -> None:
    height, width = image.pixels.shape
    if (width, height) != (camera.width, camera.height):
        raise ImageRefused(
            'wrong_size',
            f'image of {width} x {height}, prior camera of {camera.width} x {camera.height}',
        )


def check_order(image: Image, latest_ns: int | None) -> None:
    """
    Check that an image is stamped after the last one used (None: no image used yet).

    Raises ImageRefused ``out_of_order``.
    """
    if latest_ns is not None and image.time_ns <= latest_ns:
        late_s = (latest_ns - image.time_ns) * 1e-9
        words = f'{late_s:.6f} s before the last image used'
        if not late_s:
            words = 'the stamp of the last image used: two publishers on one topic?'
        raise ImageRefused('out_of_order', words)
