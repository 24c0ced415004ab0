# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations of an image sequence; each image is predicted from the previous ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ImageRefused
from starcal_ros.estimation.options import assumed_tracker_sigma_rad
from starcal_ros.identification.star_finder import Exposure, observe_stars, realigned, StarSearch
from starcal_ros.identification.tracking import start_tracking, track_stars, TrackedCamera
from starcal_ros.pipeline.setup import Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import CameraGeometry, Image, refused_image, StarObservations
from starcal_ros.sky.astrometry import velocity_of
from starcal_ros.sky.attitude import Attitude, AttitudeHistory, attitudes_at
from starcal_ros.stars.frame_checks import Fingerprint, fingerprint, sample_rows, screen
from starcal_ros.stars.hot_pixels import HotPixels, learn_hot_pixels

_SAME_ATTITUDE = 1e-12  # difference of a component; interpolation of equal samples rounds at 1e-16
_TURN_SIGMAS = 2.0  # a coarse star tracker may repeat its output within its noise
_TURN_PX = 0.1  # noise of the turn between two images, of their centroids and the prior camera
_IMAGES_OF_A_RESTART = 3  # two images may be swapped in transit, three are not
_IMAGES_OF_AN_UNFIT = 10  # cost of an unfit attitude: its search takes as long as five images


@dataclasses.dataclass(frozen=True)
class TrackerState:
    """
    State of a star tracker in an image sequence.

    ``geometry`` predicts the stars of a searched image, because mountings are not exact; None:
    that of the track.  ``camera`` measures the next image without a search; None before the first
    image.  ``first_with_same_attitude`` is the first image of the current run of bit-identical
    attitudes of images used.  ``taken`` counts the images used, ``unfit`` those for which this
    attitude was refused while another one was accepted, and ``why_unfit`` is the last reason;
    empty: its attitude was used since.
    """

    geometry: CameraGeometry | None = None
    camera: TrackedCamera | None = None
    first_with_same_attitude: StarObservations | None = None
    taken: int = 0
    unfit: int = 0
    why_unfit: str = ''


@dataclasses.dataclass(frozen=True)
class Track:
    """
    State of an image sequence.

    ``geometry`` predicts the stars of a searched image; ``latest_ns`` is the stamp of the last
    image used.  ``behind`` counts images in a row with stamps before the last one used,
    ``behind_ns`` is the stamp of the latest of them.  ``seen`` is the previous frame, used or not,
    which a stuck camera repeats; ``hot`` are the hot pixels detected so far.  ``trackers`` are the
    states of the star trackers by their frames; the first one has the empty name.
    """

    geometry: CameraGeometry
    latest_ns: int | None = None
    behind: int = 0
    behind_ns: int = 0
    seen: Fingerprint | None = None
    hot: HotPixels | None = None
    trackers: Mapping[str, TrackerState] = dataclasses.field(default_factory=dict)

    def tracker(self, name: str) -> TrackerState:
        """State of a star tracker; a new one before its first image."""
        return self.trackers.get(name, TrackerState())


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
            {name: tracker.taken for name, tracker in track.trackers.items()},
            assumed_tracker_sigma_rad(setup.calibration),
        )
        known |= vars(found[0]) | {'catalog_digest': setup.catalog.digest}
        detector, saturation_dn = setup.detector, setup.centroid.saturation_dn
        screen(sample, seen, track.seen, saturation_dn, detector.dark, setup.screening)
        corrected, centroid = detector.corrected(image, setup.centroid)
        setup = dataclasses.replace(setup, centroid=centroid)
        exposures = [
            Exposure(
                corrected,
                attitude.icrf_from_star_tracker_xyzw,
                attitude.attitude_gap_s,
                velocity,
                setup.site,
                (track.hot or detector.hot).index,
                temperature_degc,
            )
            for attitude in found
        ]
        observations, after = _with_any(found, exposures, setup, remembered)
        return dataclasses.replace(observations, pixel_digest=seen.digest), after
    except ImageRefused as refused:
        height, width = image.pixels.shape
        observations = refused_image(
            image.time_ns, width, height, refused.reason, refused.detail, **known
        )
        return observations, remembered


def _with_any(
    attitudes: Sequence[Attitude], exposures: Sequence[Exposure], setup: Setup, track: Track
) -> tuple[StarObservations, Track]:
    """Observations with the first attitude that leads to no refusal, else the first refusal."""
    refused_by_stars: list[tuple[StarObservations, Track]] = []
    errors: list[ImageRefused] = []
    unfit: dict[str, str] = {}
    for attitude, exposure in zip(attitudes, exposures, strict=True):
        try:
            observations, after = _with_one(attitude, exposure, setup, track)
        except ImageRefused as refused:
            errors.append(refused)
            why = f'{refused.reason}: {refused.detail}'
        else:
            if not observations.refusal:
                detail = '; '.join(unfit.values())
                return dataclasses.replace(observations, detail=detail), _with_unfit(after, unfit)
            refused_by_stars.append((observations, after))
            why = f'{observations.refusal}: {observations.detail}'
        label = attitude.star_tracker or setup.frames.star_tracker_frame
        unfit[attitude.star_tracker] = f'{label} not used: {why}'
    if not refused_by_stars:
        raise errors[0]
    return refused_by_stars[0]


def _with_unfit(track: Track, unfit: Mapping[str, str]) -> Track:
    """State after an image for which some star trackers were unfit, with the reason of each."""
    trackers = dict(track.trackers)
    for name, why in unfit.items():
        own = track.tracker(name)
        trackers[name] = dataclasses.replace(
            own, taken=own.taken + _IMAGES_OF_AN_UNFIT, unfit=own.unfit + 1, why_unfit=why
        )
    return dataclasses.replace(track, trackers=trackers)


def _with_one(
    attitude: Attitude, exposure: Exposure, setup: Setup, track: Track
) -> tuple[StarObservations, Track]:
    """Observations with an attitude; the new state updates that star tracker only."""
    name = attitude.star_tracker
    before = track.tracker(name)
    geometry = before.geometry or track.geometry
    observations, geometry, camera = _stars(exposure, setup.star_search, geometry, before.camera)
    observations = dataclasses.replace(observations, **vars(attitude))
    if observations.refusal:
        return observations, track
    own = TrackerState(
        geometry if name else None,
        camera,
        _first_with_same_attitude(observations, before.first_with_same_attitude, setup),
        before.taken + 1,
        before.unfit,
    )
    hot = learn_hot_pixels(
        track.hot or setup.detector.hot,
        exposure.image.pixels,
        observations.background_dn,
        observations.noise_dn,
        geometry.icrf_from_camera(exposure.icrf_from_star_tracker_xyzw),
        geometry.camera,
    )
    return observations, dataclasses.replace(
        track,
        geometry=track.geometry if name else geometry,
        latest_ns=exposure.image.time_ns,
        hot=hot,
        trackers={**track.trackers, name: own},
    )


def _stars(
    exposure: Exposure,
    search: StarSearch,
    geometry: CameraGeometry,
    tracked: TrackedCamera | None,
) -> tuple[StarObservations, CameraGeometry, TrackedCamera | None]:
    """Stars of an image by the camera of the images before it, or else by a search."""
    if tracked is not None:
        with contextlib.suppress(ImageRefused):  # the full search finds the reason of refusal
            observations, camera = track_stars(exposure, tracked, search)
            return observations, geometry, camera
    observations, instrument = observe_stars(exposure, geometry, search)
    geometry = realigned(geometry, observations)
    return observations, geometry, start_tracking(geometry, observations, instrument)


def _after_order(track: Track, time_ns: int) -> Track:
    """State when an image arrives; the third image from the past restarts the sequence."""
    if track.latest_ns is None or time_ns > track.latest_ns:
        return dataclasses.replace(track, behind=0)
    behind = track.behind + 1 if track.behind and time_ns > track.behind_ns else 1
    if behind < _IMAGES_OF_A_RESTART:
        return dataclasses.replace(track, behind=behind, behind_ns=time_ns)
    trackers = {
        name: TrackerState(unfit=tracker.unfit, why_unfit=tracker.why_unfit)
        for name, tracker in track.trackers.items()
    }
    return Track(track.geometry, hot=track.hot, trackers=trackers)


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
