# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records with a different number in every field, and exact comparison of records."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from starcal_ros.camera import CameraModel
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import (
    ALIGNMENT_TYPE,
    ATTITUDE_TYPE,
    make_header,
    POSE_TYPE,
    quaternion_to_message,
    vector_to_message,
)
from starcal_ros.record_fields import fields_of
from starcal_ros.records import (
    Amplitude,
    Calibration,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    DetectorStep,
    EnsembleStatus,
    GateCheck,
    HeldTerm,
    ModelChecks,
    ResidualBin,
    ResidualField,
    SigmaPart,
    StarObservations,
    StarTrackerAlignment,
    StatementCheck,
    TemperatureTerms,
)

TIME_NS = 1_700_000_000_123_456_789
OBSERVED = fields_of(StarObservations)
NEEDED = {kind.in_messages.split('.')[0] for kind in OBSERVED.values() if not kind.has_default}
"""Fields that a message of observations must have."""


def observations(n: int = 5) -> StarObservations:
    """Observations of n stars with a different number in every field."""
    random = np.random.default_rng(3)
    directions = random.normal(size=(n, 3))
    return dataclasses.replace(
        StarObservations.of_image(TIME_NS, (1296, 1024)),
        icrf_from_star_tracker_xyzw=np.array([0.1, 0.7, -0.1, 0.7]),
        attitude_gap_s=0.5,
        catalog_id=np.array([2**62 + k for k in range(n - 1)] + [-71683], np.int64),
        direction_icrf=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        magnitude=random.normal(size=n).astype(np.float32),
        measured_px=random.uniform(0, 1000, (n, 2)),
        covariance_px2=np.c_[random.uniform(1, 2, n), random.uniform(-1, 1, n), np.full(n, 2.0)],
        flux_dn=random.uniform(size=n).astype(np.float32),
        snr=random.uniform(size=n).astype(np.float32),
        refused_stars={'blend': 3, 'saturated': 1},
        background_dn=101.5,
        noise_dn=3.25,
        psf_sigma_px=0.95,
        catalog_digest='abc',
        temperature_degc=-12.3,
        star_tracker_rate_rad_s=np.array([1e-3, -2e-3, 5e-4]),
        star_tracker_rate_sigma_rad_s=np.array([1e-5, 2e-5, 3e-5]),
        velocity_sigma_m_s=10.0,
        zenith_icrf=np.array([0.36, 0.48, 0.8]),
        refraction_arcsec=np.array([54.0, 6.0]),
        pixel_digest='0123456789abcdef0123456789abcdef',
        refused_catalog_id=np.array([2**62 + 20, -5, 7, 8], np.int64),
        refused_px=random.uniform(0, 1000, (4, 2)).astype(np.float32),
        refused_reason=np.array([0, 1, 0, 0], np.uint8),
    )


def calibration() -> Calibration:
    """A calibration with a different number in every field."""
    parameters = [3641.5, -0.74, 3642.3, 647.5, 511.5, -0.051, 0.117, 0.01, 5.1e-4, 3.2e-4]
    camera = CameraModel(1296, 1024, np.array(parameters))
    return Calibration(
        time_ns=TIME_NS,
        geometry=CameraGeometry(camera, np.array([0.1, -0.7, 0.1, 0.7])),
        covariance=np.arange(169.0).reshape(13, 13) / 7,
        method='hierarchical',
        estimated=('fx', 'fy'),
        residual_rms_px=0.1 + 0.2,
        variance_factor=1 / 3,
        images_used=15,
        images_refused={'no_match': 2},
        stars_used=1234,
        stars_rejected=5,
        alignment_scatter_arcsec=4.5,
        star_tracker_sigma_arcsec=(9.5, 10.25, 41.0),
        centroid_scale=1.0625,
        centroid_floor_px=0.0125,
        dropped_catalog_ids=(-71683, 4295806720),
        misfit_images_ns=(1_700_000_000_123_456_789,),
        singular_values=(1.5, 0.75, 0.02),
        weakest_direction='k2 and k3 can hardly be told apart',
        zero_skew_cost_px=0.3,
        iterations=7,
        termination='cost',
        accepted=True,
        reasons=('one', 'two'),
        parent_frame='st',
        child_frame='cam',
        provenance={'catalog': 'x', 'note': 'quote " and µ'},
        temperature=TemperatureTerms(
            21.5, (4e-5, -6e-7), (1e-6, 2e-8), (1e-5, 2e-5, 3e-5), (1e-6, 2e-6, 3e-6), 'a word'
        ),
        maps=DetectorMaps(
            np.arange(6).reshape(2, 3),
            np.arange(12.0).reshape(4, 3) / 7,
            np.sqrt(np.arange(12.0)).reshape(4, 3),
        ),
        correlation=Correlation(('fx', 'fy'), np.array([[1.0, 1 / 3], [1 / 3, 1.0]])),
        star_trackers=(
            StarTrackerAlignment(
                'head',
                7,
                np.array([0.5, -0.5, 0.5, 0.5]),
                np.asarray(np.arange(9.0).reshape(3, 3) / 7e12, np.float64),
                np.array([0.6, 0.0, 0.0, 0.8]),
                np.asarray(np.arange(9.0).reshape(3, 3) / 3e12, np.float64),
                (0.1, -0.2, 1 / 3),
                0.7,
                0.25,
            ),
        ),
        model_checks=model_checks(),
        field=ResidualField(
            1,
            np.array([[11, -7, 3, 2, -1, 0.5], [5, 2.5, -12.5, 1, 4, -3]]) / 1000,
            unresolved_px=0.0625,
            covariance_factor=np.arange(50.0).reshape(25, 2) / 11,
            remainder_unit_px=np.asarray(np.arange(1.0, 13.0) / 7e4, np.float64),
            remainder=np.arange(-10, 68, dtype=np.int16),
        ),
        sigma_budget=(
            SigmaPart('total', 0.7, 12.5, ''),
            SigmaPart(
                'velocity',
                0.6,
                0.75,
                'no barycentric one given: 20 km/s per axis assumed',
                tuple(0.01 * k for k in range(63)),
            ),
        ),
        gate=(
            GateCheck('residual', 'max_residual_rms_px', 0.1 + 0.2, 0.25, 'px', False, 'a word'),
            GateCheck('stars', 'min_stars', 1234.0, 60.0, '', True),
        ),
    )


def model_checks() -> ModelChecks:
    """Checks of the model with a different number in every field, within the default limits."""
    return ModelChecks(
        field_rms_px=0.009,
        field_worst_px=0.02,
        held=(
            HeldTerm('cx', 647.5, 648.25, 1.5),
            HeldTerm('k3', 0.01, 0.02, 0.04, evidence=-1.5),
            HeldTerm('stamp_offset_s', 0.0, math.nan, math.nan),
        ),
        step=DetectorStep('u', 512.5, 'v', -0.015, 0.7),
        image_variation_px=0.03,
        amplitudes=(
            Amplitude('field, most likely amplitude', 0.0125, 'px', 41.5),
            Amplitude('change from image to image, most likely amplitude', 0.0003, 'px', 0.75),
        ),
        predictions=(
            ResidualBin('radius', 3.5, 320.25, 140, 1.02, 0.04),
            ResidualBin('magnitude', 1.5, 4.5, 137, 0.97, 0.043),
        ),
        statements=(
            StatementCheck('velocity', True, 'the velocity is 7.6 km/s from that of the Earth'),
            StatementCheck('clock', None, 'a reason'),
        ),
    )


def without_field(found: Calibration | None = None) -> Calibration:
    """A calibration, by default that of this module, of a camera that has a lens model alone."""
    found = found or calibration()
    camera = dataclasses.replace(found.geometry.camera, field=None)
    geometry = dataclasses.replace(found.geometry, camera=camera)
    return dataclasses.replace(found, geometry=geometry, field=None)


def plain_calibration() -> Calibration:
    return dataclasses.replace(
        without_field(),
        temperature=None,
        maps=None,
        correlation=None,
        star_trackers=(),
        model_checks=None,
        gate=(),
        sigma_budget=(),
    )


def status() -> EnsembleStatus:
    """A status with a different number in every field."""
    return EnsembleStatus(
        time_ns=TIME_NS,
        images=3,
        stars=40,
        min_images=5,
        min_stars=100,
        refused={'no_match': 1},
        coverage=np.arange(12).reshape(3, 4),
        parameter_names=('fx', 'fy'),
        predicted_sigma=np.array([1.5, np.inf]),
        images_saved=2,
    )


def zeroed(value: Any, is_sequence: bool) -> Any:
    """Return what ROS has in a field that a sender leaves out."""
    if isinstance(value, np.ndarray):
        return value[:0] if is_sequence else np.zeros_like(value)
    if hasattr(value, 'w'):
        return type(value)(x=0.0, y=0.0, z=0.0, w=0.0)
    return type(value)()


def with_needed_fields(sent: StarObservations, **others: Any) -> StarObservations:
    """Observations with the fields that a message must have, and these others."""
    needed = {
        name: getattr(sent, name)
        for name, kind in OBSERVED.items()
        if not kind.has_default and name not in ('time_ns', 'width', 'height')
    }
    unknown = np.full(len(sent), np.nan, np.float32)
    stars = dict.fromkeys(('magnitude', 'flux_dn', 'snr'), unknown)
    size = sent.width, sent.height
    return StarObservations.of_image(sent.time_ns, size, **needed, **stars, **others)


def attitude_message(kind: str, time_ns: int, xyzw: Any) -> Any:
    """Return a message of a type with an attitude, and zeros beside it."""
    rotation = quaternion_to_message(xyzw, make_message)
    zero = vector_to_message(np.zeros(3), make_message)
    fields: dict[str, Any] = {'header': make_header(time_ns, 'icrf', make_message)}
    if kind == ATTITUDE_TYPE:
        fields['quaternion'] = rotation
    elif kind == POSE_TYPE:
        point = make_message('geometry_msgs/msg/Point', x=1.0, y=2.0, z=3.0)
        pose = make_message('geometry_msgs/msg/Pose', position=point, orientation=rotation)
        fields['pose'] = pose
    elif kind == ALIGNMENT_TYPE:
        turn = make_message('geometry_msgs/msg/Transform', translation=zero, rotation=rotation)
        fields |= {'child_frame_id': 'st', 'transform': turn}
    else:
        vectors = ('angular_velocity', 'linear_acceleration')
        covariances = ('orientation_covariance', *(f'{name}_covariance' for name in vectors))
        fields |= {'orientation': rotation, **dict.fromkeys(vectors, zero)}
        fields |= dict.fromkeys(covariances, np.zeros(9))
    return make_message(kind, **fields)


def plain(_type: str, /, **fields: Any) -> SimpleNamespace:
    return SimpleNamespace(**fields)


def assert_same(a: Any, b: Any) -> None:
    """Assert that all fields are equal bit for bit, arrays with type and shape."""
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            assert_same(x, y)
        elif isinstance(x, tuple) and any(map(dataclasses.is_dataclass, x)):
            assert len(x) == len(y), field.name
            for one, other in zip(x, y, strict=True):
                assert_same(one, other)
        elif isinstance(x, float) and np.isnan(x):
            assert np.isnan(y), field.name
        elif isinstance(x, np.ndarray):
            assert (x.dtype, x.shape) == (y.dtype, y.shape), field.name
            assert x.tobytes() == y.tobytes(), field.name
        else:
            assert x == y, field.name
            assert type(x) is type(y) or isinstance(x, float), field.name
