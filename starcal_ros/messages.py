"""
Records to ROS messages and back, without ROS.

The functions that read take any object with the fields of the message: those that rclpy takes from
the graph and those that rosbags decodes from a file alike.  The functions that build are given
``make``, which returns a message of a type from its fields; sequences of numbers are handed to it
as flat numpy arrays of the field's own type.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
import sys
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from starcal_ros.camera import CameraModel, zero_skew_fit
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.records import (
    Calibration,
    CALIBRATION_PARAMETER_NAMES,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    EnsembleStatus,
    Halves,
    Image,
    refused_image,
    Removal,
    StarObservations,
    Thermal,
)

Floats = NDArray[np.float64]
Message = Any  # a message class of rclpy or of rosbags: they share field names and nothing else

_REMOVAL_COLUMNS = ('significance', 'wald', 'chi2_rise', 'residual_rms_px', 'map_change_px')

IMAGE_TYPE = 'sensor_msgs/msg/Image'
COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'
ATTITUDE_TYPE = 'geometry_msgs/msg/QuaternionStamped'
VELOCITY_TYPE = 'geometry_msgs/msg/TwistStamped'
TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'
CAMERA_INFO_TYPE = 'sensor_msgs/msg/CameraInfo'
ALIGNMENT_TYPE = 'geometry_msgs/msg/TransformStamped'
OBSERVATIONS_TYPE = 'starcal/msg/StarObservations'
CALIBRATION_TYPE = 'starcal/msg/Calibration'
STATUS_TYPE = 'starcal/msg/EnsembleStatus'

_PNG_MAGIC = b'\x89PNG\r\n\x1a\n'
_PIXEL_BYTES = {'mono8': 1, '8UC1': 1, 'mono16': 2, '16UC1': 2}


class Make(Protocol):
    """Builds a message of a type, ``'pkg/msg/Name'``, from its fields."""

    def __call__(self, type_name: str, /, **fields: object) -> Message:
        """Return the message."""


def stamp_ns(stamp: Message) -> int:
    """Nanoseconds of a builtin_interfaces/Time, exactly."""
    return int(stamp.sec) * NANOSECONDS_PER_SECOND + int(stamp.nanosec)


def offset_ns(seconds: float) -> int:
    """Whole nanoseconds of an offset in seconds."""
    return round(seconds * NANOSECONDS_PER_SECOND)


def make_header(time_ns: int, frame_id: str, make: Make) -> Message:
    """Return a std_msgs/Header of a time in nanoseconds."""
    return make('std_msgs/msg/Header', stamp=_make_time(time_ns, make), frame_id=frame_id)


def _make_time(time_ns: int, make: Make) -> Message:
    sec, nanosec = divmod(time_ns, NANOSECONDS_PER_SECOND)
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def decode_image(
    encoding: str,
    width: int,
    height: int,
    step: int,
    is_bigendian: bool,
    data: Any,
    time_ns: int,
) -> Image:
    """
    Pixels of an image message in native byte order, without its row padding.

    No copy where the message holds them so already.

    Parameters
    ----------
    encoding, width, height, step, is_bigendian, data
        As in sensor_msgs/Image; ``data`` is anything with a buffer of bytes.
    time_ns : int
        Middle of the exposure.

    Raises
    ------
    ImageRefused
        ``bad_encoding`` or ``bad_layout``.
    """
    pixel_bytes = _PIXEL_BYTES.get(encoding)
    if pixel_bytes is None:
        raise ImageRefused(
            'bad_encoding', f'{encoding[:40]!r} is not one of {", ".join(_PIXEL_BYTES)}'
        )
    # An empty buffer has no shape that frombuffer would take.
    flat = np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    row_bytes = width * pixel_bytes
    if width < 1 or height < 1:
        raise ImageRefused('bad_layout', f'{width} x {height} is not an image')
    if step < row_bytes:
        raise ImageRefused('bad_layout', f'step {step} is less than a row of {row_bytes} bytes')
    if flat.size != step * height:
        raise ImageRefused(
            'bad_layout', f'{flat.size} bytes of data, not {step * height} for {height} rows'
        )
    dtype = np.dtype(np.uint8 if pixel_bytes == 1 else '>u2' if is_bigendian else '<u2')
    # Strides rather than a slice: a step need not be a whole number of 16-bit pixels.
    rows: NDArray[Any] = np.ndarray(
        (height, width), dtype, buffer=flat, strides=(step, pixel_bytes)
    )
    pixels: NDArray[Any] = np.ascontiguousarray(rows, dtype.newbyteorder('='))
    pixels.setflags(write=False)
    return Image(time_ns, pixels)


def decode_png(data: Any, time_ns: int) -> Image:
    """
    Pixels of a PNG of one channel, 8 or 16 bit.

    Raises
    ------
    ImageRefused
        ``bad_encoding`` for what is no such PNG; ``bad_layout`` for one that cannot be decoded.
    """
    # A JPEG would decode too, but what it does to a star of two pixels is no measurement.
    if bytes(data[: len(_PNG_MAGIC)]) != _PNG_MAGIC:
        raise ImageRefused('bad_encoding', 'the compressed image is not a PNG')
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ImageRefused('bad_layout', f'{len(data)} bytes of PNG cannot be decoded')
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise ImageRefused(
            'bad_encoding', f'the PNG is {pixels.dtype} of shape {pixels.shape}, not one channel'
        )
    pixels.setflags(write=False)
    return Image(time_ns, pixels)  # type: ignore[arg-type]


def image_from_message(message: Message, stamp_offset_s: float = 0.0) -> Image:
    """
    Image of a sensor_msgs/Image or CompressedImage, its time shifted to the middle of exposure.

    Raises
    ------
    ImageRefused
        ``bad_encoding`` or ``bad_layout``.
    """
    if not hasattr(message, 'encoding'):
        time_ns = stamp_ns(message.header.stamp) + offset_ns(stamp_offset_s)
        return decode_png(message.data, time_ns)
    return decode_image(
        message.encoding,
        message.width,
        message.height,
        message.step,
        bool(message.is_bigendian),
        message.data,
        stamp_ns(message.header.stamp) + offset_ns(stamp_offset_s),
    )


def refused_from_message(
    message: Message, stamp_offset_s: float, refused: ImageRefused
) -> StarObservations:
    """Return the observations of an image message that cannot be used."""
    return refused_image(
        stamp_ns(message.header.stamp) + offset_ns(stamp_offset_s),
        int(getattr(message, 'width', 0)),  # a compressed image does not say
        int(getattr(message, 'height', 0)),
        refused.reason,
        refused.detail,
    )


def image_to_message(image: Image, frame_id: str, make: Make) -> Message:
    """Return a sensor_msgs/Image, mono8 or mono16 in the byte order of this machine."""
    pixels = np.ascontiguousarray(image.pixels)
    height, width = pixels.shape
    return make(
        IMAGE_TYPE,
        header=make_header(image.time_ns, frame_id, make),
        height=height,
        width=width,
        encoding='mono8' if pixels.itemsize == 1 else 'mono16',
        is_bigendian=int(sys.byteorder == 'big'),
        step=width * pixels.itemsize,
        data=pixels.reshape(-1).view(np.uint8),
    )


def color_image_to_message(
    time_ns: int, bgr: NDArray[np.uint8], frame_id: str, make: Make
) -> Message:
    """Return a sensor_msgs/Image bgr8 of a (height, width, 3) picture."""
    height, width, _ = bgr.shape
    return make(
        IMAGE_TYPE,
        header=make_header(time_ns, frame_id, make),
        height=height,
        width=width,
        encoding='bgr8',
        is_bigendian=0,
        step=width * 3,
        data=np.ascontiguousarray(bgr).reshape(-1),
    )


def attitude_from_message(message: Message) -> tuple[int, Floats]:
    """Stamp and (4,) xyzw of a geometry_msgs/QuaternionStamped, as on the wire and unchecked."""
    return stamp_ns(message.header.stamp), _quaternion_from_message(message.quaternion)


def attitude_to_message(
    time_ns: int, quaternion_xyzw: Floats, frame_id: str, make: Make
) -> Message:
    """Return a geometry_msgs/QuaternionStamped; ``frame_id`` is the inertial frame."""
    return make(
        ATTITUDE_TYPE,
        header=make_header(time_ns, frame_id, make),
        quaternion=_quaternion_to_message(quaternion_xyzw, make),
    )


def velocity_from_message(message: Message) -> tuple[int, Floats]:
    """Stamp and (3,) m/s of a geometry_msgs/TwistStamped."""
    linear = message.twist.linear
    return stamp_ns(message.header.stamp), np.array([linear.x, linear.y, linear.z], np.float64)


def velocity_to_message(time_ns: int, velocity_m_s: Floats, frame_id: str, make: Make) -> Message:
    """Return a geometry_msgs/TwistStamped without rotation."""
    return make(
        VELOCITY_TYPE,
        header=make_header(time_ns, frame_id, make),
        twist=make(
            'geometry_msgs/msg/Twist',
            linear=_vector_to_message(velocity_m_s, make),
            angular=_vector_to_message(np.zeros(3), make),
        ),
    )


def temperature_from_message(message: Message) -> tuple[int, float]:
    """Stamp and degrees Celsius of a sensor_msgs/Temperature; NaN where it is not finite."""
    temperature_degc = float(message.temperature)
    known = math.isfinite(temperature_degc)
    return stamp_ns(message.header.stamp), temperature_degc if known else math.nan


def temperature_to_message(
    time_ns: int, temperature_degc: float, frame_id: str, make: Make
) -> Message:
    """Return a sensor_msgs/Temperature; its variance is not known, which ROS writes as 0."""
    return make(
        TEMPERATURE_TYPE,
        header=make_header(time_ns, frame_id, make),
        temperature=float(temperature_degc),
        variance=0.0,
    )


def observations_to_message(record: StarObservations, frame_id: str, make: Make) -> Message:
    """Return a starcal/StarObservations; ``frame_id`` is the camera's."""
    return make(
        OBSERVATIONS_TYPE,
        header=make_header(record.time_ns, frame_id, make),
        width=record.width,
        height=record.height,
        refusal=record.refusal,
        detail=record.detail,
        attitude=_quaternion_to_message(record.icrf_from_star_tracker_xyzw, make),
        attitude_gap_s=float(record.attitude_gap_s),
        temperature_degc=float(record.temperature_degc),
        catalog_id=_flat(record.catalog_id, np.int64),
        direction_icrf=_flat(record.direction_icrf, np.float64),
        magnitude=_flat(record.magnitude, np.float32),
        measured_px=_flat(record.measured_px, np.float64),
        covariance_px2=_flat(record.covariance_px2, np.float64),
        flux_dn=_flat(record.flux_dn, np.float32),
        snr=_flat(record.snr, np.float32),
        refused_star_reasons=list(record.refused_stars),
        refused_star_counts=_flat(list(record.refused_stars.values()), np.uint32),
        refused_star_id=_flat(record.refused_catalog_id, np.int64),
        refused_star_px=_flat(record.refused_px, np.float32),
        refused_star_reason=_flat(record.refused_reason, np.uint8),
        background_dn=float(record.background_dn),
        noise_dn=float(record.noise_dn),
        psf_sigma_px=float(record.psf_sigma_px),
        catalog_digest=record.catalog_digest,
    )


def observations_from_message(message: Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations.

    Raises
    ------
    ValueError
        When the arrays of the message do not fit each other or hold what no star has.
    """
    catalog_id = np.array(message.catalog_id, np.int64)
    n = len(catalog_id)
    record = StarObservations(
        time_ns=stamp_ns(message.header.stamp),
        width=int(message.width),
        height=int(message.height),
        refusal=str(message.refusal),
        detail=str(message.detail),
        icrf_from_star_tracker_xyzw=_quaternion_from_message(message.attitude),
        attitude_gap_s=float(message.attitude_gap_s),
        catalog_id=catalog_id,
        direction_icrf=_shaped('direction_icrf', message.direction_icrf, (n, 3)),
        magnitude=_shaped('magnitude', message.magnitude, (n,)).astype(np.float32),
        measured_px=_shaped('measured_px', message.measured_px, (n, 2)),
        covariance_px2=_shaped('covariance_px2', message.covariance_px2, (n, 3)),
        flux_dn=_shaped('flux_dn', message.flux_dn, (n,)).astype(np.float32),
        snr=_shaped('snr', message.snr, (n,)).astype(np.float32),
        refused_stars=_counts(message.refused_star_reasons, message.refused_star_counts),
        background_dn=float(message.background_dn),
        noise_dn=float(message.noise_dn),
        psf_sigma_px=float(message.psf_sigma_px),
        catalog_digest=str(message.catalog_digest),
        # Recordings of before the field was there have none.
        temperature_degc=float(getattr(message, 'temperature_degc', math.nan)),
        **_refused_stars(message),
    )
    for name in (
        'direction_icrf',
        'measured_px',
        'covariance_px2',
        'icrf_from_star_tracker_xyzw',
        'refused_px',
    ):
        if not np.isfinite(getattr(record, name)).all():
            raise ValueError(f'{name}: not finite')
    uu, uv, vv = record.covariance_px2.T
    if not ((uu > 0) & (uu * vv > uv * uv)).all():
        raise ValueError('covariance_px2: not positive definite')
    return record


def _refused_stars(message: Message) -> dict[str, Any]:
    """Fields of the record about single refused stars."""
    # Recordings of before the fields were there have none.
    catalog_id = np.array(getattr(message, 'refused_star_id', ()), np.int64)
    m = len(catalog_id)
    reason = _shaped('refused_star_reason', getattr(message, 'refused_star_reason', ()), (m,))
    if (reason >= len(message.refused_star_reasons)).any():
        raise ValueError(
            f'refused_star_reason: {int(reason.max())} is none of '
            f'{len(message.refused_star_reasons)} reasons'
        )
    places = _shaped('refused_star_px', getattr(message, 'refused_star_px', ()), (m, 2))
    return {
        'refused_catalog_id': catalog_id,
        'refused_px': places.astype(np.float32),
        'refused_reason': reason.astype(np.uint8),
    }


def status_to_message(status: EnsembleStatus, frame_id: str, make: Make) -> Message:
    """Return a starcal/EnsembleStatus; ``frame_id`` is the camera's."""
    rows, cols = status.coverage.shape
    return make(
        STATUS_TYPE,
        header=make_header(status.time_ns, frame_id, make),
        images=status.images,
        images_saved=status.images_saved,
        stars=status.stars,
        min_images=status.min_images,
        min_stars=status.min_stars,
        refused_reasons=list(status.refused),
        refused_counts=_flat(list(status.refused.values()), np.uint32),
        coverage_rows=rows,
        coverage_cols=cols,
        coverage=_flat(status.coverage, np.uint32),
        parameter_names=list(status.parameter_names),
        predicted_sigma=_flat(status.predicted_sigma, np.float64),
    )


def status_from_message(message: Message) -> EnsembleStatus:
    """
    Ensemble status of a starcal/EnsembleStatus.

    Raises
    ------
    ValueError
        When the arrays of the message do not fit each other.
    """
    shape = int(message.coverage_rows), int(message.coverage_cols)
    names = tuple(str(name) for name in message.parameter_names)
    return EnsembleStatus(
        time_ns=stamp_ns(message.header.stamp),
        images=int(message.images),
        images_saved=int(message.images_saved),
        stars=int(message.stars),
        min_images=int(message.min_images),
        min_stars=int(message.min_stars),
        refused=_counts(message.refused_reasons, message.refused_counts),
        coverage=_shaped('coverage', message.coverage, shape).astype(np.int64),
        parameter_names=names,
        predicted_sigma=_shaped('predicted_sigma', message.predicted_sigma, (len(names),)),
    )


def calibration_to_message(calibration: Calibration, make: Make) -> Message:
    """Return a starcal/Calibration, every number as the record has it."""
    camera = calibration.geometry.camera
    fx, skew, fy, cx, cy = (float(value) for value in camera.intrinsics)
    return make(
        CALIBRATION_TYPE,
        header=make_header(calibration.time_ns, calibration.child_frame, make),
        accepted=calibration.accepted,
        reasons=list(calibration.reasons),
        forced=calibration.forced,
        **_halves_fields(calibration.halves),
        number=calibration.number,
        in_force_since=_make_time(calibration.in_force_since_ns, make),
        first_image=_make_time(calibration.first_image_ns, make),
        width=camera.width,
        height=camera.height,
        fx=fx,
        skew=skew,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=_flat(camera.distortion, np.float64),
        parent_frame=calibration.parent_frame,
        alignment=_quaternion_to_message(calibration.geometry.star_tracker_from_camera_xyzw, make),
        parameter_names=list(CALIBRATION_PARAMETER_NAMES),
        covariance=_flat(calibration.covariance, np.float64),
        method=calibration.method,
        estimated=list(calibration.estimated),
        residual_rms_px=float(calibration.residual_rms_px),
        variance_factor=float(calibration.variance_factor),
        images_used=calibration.images_used,
        stars_used=calibration.stars_used,
        stars_rejected=calibration.stars_rejected,
        refused_reasons=list(calibration.images_refused),
        refused_counts=_flat(list(calibration.images_refused.values()), np.uint32),
        alignment_scatter_arcsec=float(calibration.alignment_scatter_arcsec),
        star_tracker_sigma_arcsec=_flat(calibration.star_tracker_sigma_arcsec, np.float64),
        centroid_scale=float(calibration.centroid_scale),
        centroid_floor_px=float(calibration.centroid_floor_px),
        dropped_catalog_ids=_flat(calibration.dropped_catalog_ids, np.int64),
        misfit_images_ns=_flat(calibration.misfit_images_ns, np.int64),
        singular_values=_flat(calibration.singular_values, np.float64),
        weakest_direction=calibration.weakest_direction,
        **_thermal_fields(calibration.thermal),
        **_maps_fields(calibration.maps),
        **_correlation_fields(calibration.correlation),
        **_removal_fields(calibration.removals),
        zero_skew_cost_px=float(calibration.zero_skew_cost_px),
        iterations=calibration.iterations,
        termination=calibration.termination,
        provenance_keys=list(calibration.provenance),
        provenance_values=list(calibration.provenance.values()),
    )


def calibration_from_message(message: Message) -> Calibration:
    """
    Calibration of a starcal/Calibration.

    Raises
    ------
    ValueError
        When the message does not hold a camera: an empty one, say.
    """
    names = tuple(str(name) for name in message.parameter_names)
    if names != CALIBRATION_PARAMETER_NAMES:
        raise ValueError(f'parameter_names: {", ".join(names) or "none"} are not the thirteen')
    intrinsics = [message.fx, message.skew, message.fy, message.cx, message.cy]
    camera = CameraModel(
        int(message.width), int(message.height), np.r_[intrinsics, message.distortion]
    )
    alignment = _quaternion_from_message(message.alignment)
    if not abs(np.linalg.norm(alignment) - 1.0) < 1e-6:  # what rounding to a text could leave
        raise ValueError(f'alignment: {alignment.tolist()} is not a unit quaternion')
    provenance = zip(message.provenance_keys, message.provenance_values, strict=True)
    return Calibration(
        time_ns=stamp_ns(message.header.stamp),
        geometry=CameraGeometry(camera, alignment),
        covariance=_shaped('covariance', message.covariance, (len(names), len(names))),
        method=str(message.method),
        estimated=tuple(str(name) for name in message.estimated),
        residual_rms_px=float(message.residual_rms_px),
        variance_factor=float(message.variance_factor),
        images_used=int(message.images_used),
        images_refused=_counts(message.refused_reasons, message.refused_counts),
        stars_used=int(message.stars_used),
        stars_rejected=int(message.stars_rejected),
        alignment_scatter_arcsec=float(message.alignment_scatter_arcsec),
        star_tracker_sigma_arcsec=tuple(float(s) for s in message.star_tracker_sigma_arcsec),
        centroid_scale=float(message.centroid_scale),
        centroid_floor_px=float(message.centroid_floor_px),
        dropped_catalog_ids=tuple(int(i) for i in message.dropped_catalog_ids),
        misfit_images_ns=tuple(int(t) for t in message.misfit_images_ns),
        singular_values=tuple(float(s) for s in message.singular_values),
        weakest_direction=str(message.weakest_direction),
        zero_skew_cost_px=float(message.zero_skew_cost_px),
        iterations=int(message.iterations),
        termination=str(message.termination),
        accepted=bool(message.accepted),
        reasons=tuple(str(reason) for reason in message.reasons),
        parent_frame=str(message.parent_frame),
        child_frame=str(message.header.frame_id),
        provenance={str(key): str(value) for key, value in provenance},
        thermal=_thermal_from_message(message),
        maps=_maps_from_message(message),
        correlation=_correlation_from_message(message),
        removals=_removals_from_message(message),
        first_image_ns=stamp_ns(message.first_image),
        number=int(message.number),
        in_force_since_ns=stamp_ns(message.in_force_since),
        forced=bool(message.forced),
        halves=_halves_from_message(message),
    )


def _maps_fields(maps: DetectorMaps | None) -> dict[str, object]:
    maps = maps or DetectorMaps(np.empty((0, 0), np.int64), np.empty((0, 0)), np.empty((0, 0)))
    coverage_rows, coverage_cols = maps.stars.shape
    map_rows, map_cols = maps.line_of_sight_sigma_arcsec.shape
    return {
        'coverage_rows': coverage_rows,
        'coverage_cols': coverage_cols,
        'coverage': _flat(maps.stars, np.uint32),
        'map_rows': map_rows,
        'map_cols': map_cols,
        'line_of_sight_sigma_arcsec': _flat(maps.line_of_sight_sigma_arcsec, np.float64),
        'shape_sigma_arcsec': _flat(maps.shape_sigma_arcsec, np.float64),
    }


def _maps_from_message(message: Message) -> DetectorMaps | None:
    if not getattr(message, 'coverage_rows', 0):
        return None
    cells = (int(message.coverage_rows), int(message.coverage_cols))
    grid = (int(message.map_rows), int(message.map_cols))
    return DetectorMaps(
        _shaped('coverage', message.coverage, cells).astype(np.int64),
        _shaped('line_of_sight_sigma_arcsec', message.line_of_sight_sigma_arcsec, grid),
        _shaped('shape_sigma_arcsec', message.shape_sigma_arcsec, grid),
    )


def _removal_fields(removals: tuple[Removal, ...]) -> dict[str, object]:
    stds = np.array([removal.residual_std_px for removal in removals]).reshape(-1, 2)
    columns = {
        f'removal_{name}': _flat([getattr(removal, name) for removal in removals], np.float64)
        for name in _REMOVAL_COLUMNS
    }
    return {
        'removal_removed': [removal.removed for removal in removals],
        'removal_within_chance': _flat([r.within_chance for r in removals], np.uint8),
        'removal_residual_std_u_px': _flat(stds[:, 0], np.float64),
        'removal_residual_std_v_px': _flat(stds[:, 1], np.float64),
        **columns,
    }


def _removals_from_message(message: Message) -> tuple[Removal, ...]:
    names = [str(name) for name in getattr(message, 'removal_removed', ())]
    if not names:
        return ()
    fields = (*_REMOVAL_COLUMNS, 'residual_std_u_px', 'residual_std_v_px', 'within_chance')
    columns = {
        field: _shaped(
            f'removal_{field}', getattr(message, f'removal_{field}'), (len(names),)
        ).tolist()
        for field in fields
    }
    return tuple(
        Removal(
            removed=name,
            within_chance=bool(columns['within_chance'][k]),
            residual_std_px=(columns['residual_std_u_px'][k], columns['residual_std_v_px'][k]),
            **{field: columns[field][k] for field in _REMOVAL_COLUMNS},
        )
        for k, name in enumerate(names)
    )


def _correlation_fields(correlation: Correlation | None) -> dict[str, object]:
    correlation = correlation or Correlation((), np.empty((0, 0)))
    return {
        'correlation_names': list(correlation.names),
        'correlation': _flat(correlation.matrix, np.float64),
    }


def _correlation_from_message(message: Message) -> Correlation | None:
    names = tuple(str(name) for name in getattr(message, 'correlation_names', ()))
    if not names:
        return None
    matrix = _shaped('correlation', message.correlation, (len(names), len(names)))
    return Correlation(names, matrix)


def _halves_fields(halves: Halves | None) -> dict[str, object]:
    halves = halves or Halves(math.nan, math.nan, math.nan, math.nan)
    return {
        'halves_shape_px': float(halves.shape_px),
        'halves_shape_chance': float(halves.shape_chance),
        'halves_turn_arcsec': float(halves.turn_arcsec),
        'halves_chance': float(halves.chance),
    }


def _halves_from_message(message: Message) -> Halves | None:
    if math.isnan(message.halves_chance):
        return None
    return Halves(
        shape_px=float(message.halves_shape_px),
        shape_chance=float(message.halves_shape_chance),
        turn_arcsec=float(message.halves_turn_arcsec),
        chance=float(message.halves_chance),
    )


def _thermal_fields(thermal: Thermal | None) -> dict[str, object]:
    thermal = thermal or Thermal(math.nan)
    return {
        'reference_temperature_degc': float(thermal.reference_degc),
        'focal_per_degc': _flat(thermal.focal_per_degc, np.float64),
        'focal_per_degc_sigma': _flat(thermal.focal_sigma, np.float64),
        'alignment_rate_rad_per_degc': _flat(thermal.alignment_rate_rad_per_degc, np.float64),
        'alignment_rate_rad_per_degc_sigma': _flat(thermal.alignment_rate_sigma, np.float64),
        'temperature_note': thermal.note,
    }


def _thermal_from_message(message: Message) -> Thermal | None:
    reference_degc = float(getattr(message, 'reference_temperature_degc', math.nan))
    if math.isnan(reference_degc):
        return None
    q, axes = len(message.focal_per_degc), len(message.alignment_rate_rad_per_degc)
    if axes not in (0, 3):
        raise ValueError(f'alignment_rate_rad_per_degc: {axes} numbers, not 3 or none')
    focal = _shaped('focal_per_degc', message.focal_per_degc, (q,))
    focal_sigma = _shaped('focal_per_degc_sigma', message.focal_per_degc_sigma, (q,))
    rate = _shaped('alignment_rate_rad_per_degc', message.alignment_rate_rad_per_degc, (axes,))
    rate_sigma = _shaped(
        'alignment_rate_rad_per_degc_sigma', message.alignment_rate_rad_per_degc_sigma, (axes,)
    )
    return Thermal(
        reference_degc=reference_degc,
        focal_per_degc=tuple(focal.tolist()),
        focal_sigma=tuple(focal_sigma.tolist()),
        alignment_rate_rad_per_degc=tuple(rate.tolist()),
        alignment_rate_sigma=tuple(rate_sigma.tolist()),
        note=str(message.temperature_note),
    )


def camera_info_to_message(calibration: Calibration, make: Make) -> Message:
    """
    Return a sensor_msgs/CameraInfo: the best camera without skew, as ``plumb_bob``.

    Skew does not fit: readers of camera_info take K[0,1] as 0 without a word.
    """
    camera, _ = zero_skew_fit(calibration.geometry.camera)
    fx, _, fy, cx, cy = camera.intrinsics
    k1, k2, k3, p1, p2 = camera.distortion
    return make(
        CAMERA_INFO_TYPE,
        header=make_header(calibration.time_ns, calibration.child_frame, make),
        height=camera.height,
        width=camera.width,
        distortion_model='plumb_bob',
        d=np.array([k1, k2, p1, p2, k3]),
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).ravel(),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        binning_x=0,
        binning_y=0,
        roi=make(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def alignment_to_message(calibration: Calibration, make: Make) -> Message:
    """Return a geometry_msgs/TransformStamped: the camera frame in the star tracker frame."""
    return make(
        ALIGNMENT_TYPE,
        header=make_header(calibration.time_ns, calibration.parent_frame, make),
        child_frame_id=calibration.child_frame,
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=_vector_to_message(np.zeros(3), make),
            rotation=_quaternion_to_message(
                calibration.geometry.star_tracker_from_camera_xyzw, make
            ),
        ),
    )


def _quaternion_to_message(xyzw: Floats, make: Make) -> Message:
    x, y, z, w = (float(value) for value in xyzw)
    return make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)


def _quaternion_from_message(quaternion: Message) -> Floats:
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)


def _vector_to_message(xyz: Floats, make: Make) -> Message:
    x, y, z = (float(value) for value in xyz)
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def _flat(values: object, dtype: type[np.generic]) -> NDArray[Any]:
    # Flat and contiguous: rclpy serialises a nested array as garbage without an error.
    return np.ascontiguousarray(values, dtype).reshape(-1)


def _shaped(name: str, values: object, shape: tuple[int, ...]) -> Floats:
    flat = np.array(values, np.float64)
    if flat.size != np.prod(shape):
        raise ValueError(f'{name}: {flat.size} numbers, not {" x ".join(map(str, shape))}')
    return flat.reshape(shape)


def _counts(reasons: Sequence[str], counts: Sequence[int]) -> Mapping[str, int]:
    if len(reasons) != len(counts):
        raise ValueError(f'{len(reasons)} reasons but {len(counts)} counts')
    return {str(reason): int(count) for reason, count in zip(reasons, counts, strict=True)}
