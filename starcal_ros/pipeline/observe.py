"""Star observations of an image sequence; each image is predicted from those before it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import dataclasses
from dataclasses import dataclass
import math
import operator
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.bag import reader
from starcal_ros.camera import CameraModel
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.star_finder import Exposure, observe_stars, realigned
from starcal_ros.identification.tracking import start_tracking, track_stars, TrackedCamera
from starcal_ros.image.centroiding import saturation_level
from starcal_ros.image.frame_checks import Fingerprint, fingerprint, sample_rows, screen
from starcal_ros.image.hot_pixels import HotPixels, learn_hot_pixels
from starcal_ros.pipeline.detector_frames import flattened
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, refused_image, StarObservations
from starcal_ros.sky.attitude import AttitudeHistory

T = TypeVar('T')
OnImage = Callable[[Image, StarObservations, CameraGeometry], None]

_IMAGES_OF_A_RESTART = 3  # two images may be swapped in transit, three are not


@dataclass(frozen=True)
class Track:
    """
    State of an image sequence.

    ``geometry`` is what an image is searched with; ``latest_ns`` stamps the last one used.
    ``tracked_camera`` measures the next image without a search; None before the first image.
    ``behind`` images in a row, the last of them at ``behind_ns``, were stamped before the last one
    used.  ``seen`` is the last frame of all, used or not,
    which a stuck camera shows again; ``hot`` the hot pixels found so far.
    """

    geometry: CameraGeometry
    latest_ns: int | None = None
    tracked_camera: TrackedCamera | None = None
    behind: int = 0
    behind_ns: int = 0
    seen: Fingerprint | None = None
    hot: HotPixels | None = None


def observe_next(
    image: Image,
    attitudes: AttitudeHistory,
    setup: Setup,
    track: Track,
    velocity_m_s: Floats | None = None,
    temperature_degc: float = math.nan,
) -> tuple[StarObservations, Track]:
    """
    Observations of the next image of a sequence, and the state of the sequence after it.

    A sequence starts with the prior or the active calibration.  An image stamped at or before the
    last one used is refused and does not change the state, so that one wrong stamp costs one
    image.  After the third such image in a row, in order among themselves, the sequence restarts
    with that image: a clock was set back, or a recording is played again.  An image with the
    pixels of the image before, used or not, and another stamp is refused.
    """
    track = _after_order(track, image.time_ns)
    known: dict[str, object] = {'temperature_degc': temperature_degc}
    remembered = track
    try:
        check_order(image, track.latest_ns)
        _check_size(image, track.geometry.camera)
        sample = sample_rows(image.pixels)
        seen = fingerprint(image, sample)
        remembered = dataclasses.replace(track, seen=seen)
        quaternion, gap_s = attitudes.at(image.time_ns, setup.attitude.max_attitude_gap_s)
        known |= {
            'icrf_from_star_tracker_xyzw': quaternion,
            'attitude_gap_s': gap_s,
            'catalog_digest': setup.catalog.digest,
        }
        saturation_dn = setup.centroid.saturation_dn
        screen(sample, seen, track.seen, saturation_dn, setup.dark, setup.screening)
        hot = (track.hot or setup.hot).index
        exposure = Exposure(
            flattened(_without_dark(image, setup), setup.flat, setup.dark_pedestal_dn),
            quaternion,
            gap_s,
            velocity_m_s,
            setup.site,
            hot,
            temperature_degc,
        )
        return _stars(exposure, setup, remembered)
    except ImageRefused as refused:
        height, width = image.pixels.shape
        observations = refused_image(
            image.time_ns, width, height, refused.reason, refused.detail, **known
        )
        return observations, remembered


def observe(
    image: Image,
    attitudes: AttitudeHistory,
    setup: Setup,
    geometry: CameraGeometry,
    velocity_m_s: Floats | None = None,
) -> StarObservations:
    """
    Observations of one image, or the record of its refusal; never raises for a bad image.

    ``geometry`` predicts the stars: the prior or the active calibration.  ``velocity_m_s`` (3,) is
    the observer's barycentric velocity, ICRF axes; None: the Earth's.
    """
    return observe_next(image, attitudes, setup, Track(geometry), velocity_m_s)[0]


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


def _after_order(track: Track, time_ns: int) -> Track:
    """State when an image arrives; the third image from the past restarts the sequence."""
    if track.latest_ns is None or time_ns > track.latest_ns:
        return dataclasses.replace(track, behind=0)
    behind = track.behind + 1 if track.behind and time_ns > track.behind_ns else 1
    if behind < _IMAGES_OF_A_RESTART:
        return dataclasses.replace(track, behind=behind, behind_ns=time_ns)
    return Track(track.geometry, hot=track.hot)


def _stars(exposure: Exposure, setup: Setup, track: Track) -> tuple[StarObservations, Track]:
    """The stars where the images before say, or else where a search of the image finds them."""
    time_ns = exposure.image.time_ns
    if track.tracked_camera is not None:
        try:
            observations, tracked_camera = track_stars(
                exposure, track.tracked_camera, setup.catalog, setup.centroid, setup.identification
            )
            # Accurate to a few pixels with the camera of the search, whose window is wider.
            geometry = dataclasses.replace(
                track.geometry,
                star_tracker_from_camera_xyzw=tracked_camera.geometry.star_tracker_from_camera_xyzw,
            )
            after = dataclasses.replace(
                track, geometry=geometry, latest_ns=time_ns, tracked_camera=tracked_camera
            )
            return observations, _with_hot_pixels(after, exposure, observations, setup)
        except ImageRefused:
            pass  # the full search finds the reason of refusal
    observations, instrument = observe_stars(
        exposure, track.geometry, setup.catalog, setup.centroid, setup.identification
    )
    if observations.refusal:
        return observations, track
    geometry = realigned(track.geometry, observations)
    after = dataclasses.replace(
        track,
        geometry=geometry,
        latest_ns=time_ns,
        tracked_camera=start_tracking(geometry, observations, instrument),
    )
    return observations, _with_hot_pixels(after, exposure, observations, setup)


def _with_hot_pixels(
    track: Track, exposure: Exposure, observations: StarObservations, setup: Setup
) -> Track:
    """The track with the hot pixels that an image shows, which is aligned as the track says."""
    icrf_from_star_tracker = Rotation.from_quat(exposure.icrf_from_star_tracker_xyzw)
    hot = learn_hot_pixels(
        track.hot or setup.hot,
        exposure.image.pixels,
        observations.background_dn,
        observations.noise_dn,
        icrf_from_star_tracker * Rotation.from_quat(track.geometry.star_tracker_from_camera_xyzw),
        float(track.geometry.camera.parameters[0]),
        setup.fixed_pattern,
    )
    return dataclasses.replace(track, hot=hot)


def check_order(image: Image, latest_ns: int | None) -> None:
    """
    Check that an image is stamped after the last one used (None: no image used yet).

    Raises
    ------
    ImageRefused
        ``out_of_order``.
    """
    if latest_ns is not None and image.time_ns <= latest_ns:
        late_s = (latest_ns - image.time_ns) * 1e-9
        raise ImageRefused('out_of_order', f'{late_s:.6f} s before the last image used')


def _check_size(image: Image, camera: CameraModel) -> None:
    height, width = image.pixels.shape
    if (width, height) != (camera.width, camera.height):
        raise ImageRefused(
            'wrong_size',
            f'image of {width} x {height}, prior camera of {camera.width} x {camera.height}',
        )


def latest_at(samples: Sequence[tuple[int, T]], time_ns: int, without: T) -> T:
    """
    Last sample at or before a time, else the first after it; ``without`` if there are none.

    Within a minute, the velocity of a spacecraft changes by under 10 m/s (0.007 arcsec), and the
    temperature of a camera by less than the resolution of its sensor.
    """
    before = [sample for stamp_ns, sample in samples if stamp_ns <= time_ns]
    if before:
        return before[-1]
    return samples[0][1] if samples else without


def observe_bag(
    paths: Sequence[Path],
    image_topic: str,
    attitude_topic: str,
    setup: Setup,
    velocity_topic: str = '',
    temperature_topic: str = '',
    on_image: OnImage | None = None,
) -> Iterator[StarObservations]:
    """
    Observations of every image of a bag, in bag order, with one image in memory at a time.

    ``on_image`` is called with each decoded image, its observations and the geometry that
    predicted its stars.

    Raises
    ------
    BagError
        When the bag cannot be read or a topic is not in it.
    """
    attitudes = reader.read_attitudes(paths, attitude_topic, setup.attitude)
    by_time = operator.itemgetter(0)
    velocities: list[tuple[int, Floats]] = []
    temperatures: list[tuple[int, float]] = []
    if velocity_topic:
        velocities = sorted(reader.read_velocities(paths, velocity_topic), key=by_time)
    if temperature_topic:
        temperatures = sorted(reader.read_temperatures(paths, temperature_topic), key=by_time)
    track = Track(setup.prior)
    offset_s, channel = setup.attitude.stamp_offset_s, setup.frames.image_channel
    for image in reader.read_images(paths, image_topic, offset_s, channel=channel):
        if isinstance(image, StarObservations):
            yield image
            continue
        predicted_with = track.geometry
        observations, track = observe_next(
            image,
            attitudes,
            setup,
            track,
            latest_at(velocities, image.time_ns, None),
            latest_at(temperatures, image.time_ns, math.nan),
        )
        if on_image is not None:
            on_image(image, observations, predicted_with)
        yield observations
