"""Messages: images of every layout, round trips of records through hand-made messages."""

from __future__ import annotations

import array
import dataclasses
import sys
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from starcal_ros import messages
from starcal_ros.bag import make_message
from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.errors import ImageRefused
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    EnsembleStatus,
    Image,
    refused_image,
    Removal,
    StarObservations,
    Thermal,
)

TIME_NS = 1_700_000_000_123_456_789
RAMP = np.arange(12, dtype=np.uint16).reshape(3, 4) * 257 + 3


def plain(_type: str, /, **fields: Any) -> SimpleNamespace:
    """Return a message that is nothing but its fields."""
    return SimpleNamespace(**fields)


def decode(encoding: str, big: bool, padding: int, container: Any) -> Image:
    """Image of a ramp laid out as asked, with rubbish in the row padding."""
    dtype = 'u1' if encoding in ('mono8', '8UC1') else '>u2' if big else '<u2'
    rows = RAMP.astype(dtype).view(np.uint8).reshape(3, -1)
    padded = np.hstack([rows, np.full((3, padding), 0xAA, np.uint8)])
    data = container(padded.tobytes())
    return messages.decode_image(encoding, 4, 3, padded.shape[1], big, data, TIME_NS)


@pytest.mark.parametrize(
    'container', [bytes, bytearray, memoryview, lambda b: array.array('B', b)]
)
@pytest.mark.parametrize('padding', [0, 1, 6])
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('encoding', ['mono8', '8UC1', 'mono16', '16UC1'])
def test_image_layouts(encoding: str, big: bool, padding: int, container: Any) -> None:
    """Either byte order and any row padding give the same native pixels."""
    image = decode(encoding, big, padding, container)
    dtype = np.dtype(np.uint8 if '8' in encoding else np.uint16)
    assert image.time_ns == TIME_NS
    assert image.pixels.dtype == dtype and image.pixels.dtype.isnative
    np.testing.assert_array_equal(image.pixels, RAMP.astype(dtype))


def test_native_images_are_not_copied() -> None:
    """Pixels that are laid out right already are only looked at."""
    data = np.zeros(1024 * 1296 * 2, np.uint8)
    big = sys.byteorder == 'big'
    image = messages.decode_image('mono16', 1296, 1024, 2592, big, data, 0)
    assert np.shares_memory(image.pixels, data)
    assert not image.pixels.flags.writeable


@pytest.mark.parametrize(
    ('change', 'reason', 'detail'),
    [
        ({'encoding': 'rgb8'}, 'bad_encoding', "'rgb8' is not one of mono8"),
        ({'encoding': ''}, 'bad_encoding', "'' is not"),
        ({'encoding': 'x' * 9999}, 'bad_encoding', 'xxx'),
        ({'width': 0}, 'bad_layout', '0 x 3'),
        ({'height': 0}, 'bad_layout', '4 x 0'),
        ({'step': 7}, 'bad_layout', 'step 7 is less than a row of 8 bytes'),
        ({'step': 9}, 'bad_layout', '24 bytes of data, not 27'),
        ({'data': b''}, 'bad_layout', '0 bytes of data'),
        ({'data': bytes(25)}, 'bad_layout', '25 bytes of data'),
        ({'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1}, 'bad_layout', 'step'),
    ],
)
def test_image_refusals(change: dict[str, Any], reason: str, detail: str) -> None:
    """An image that does not fit its own description is refused by name, with what was found."""
    fields: dict[str, Any] = {
        'encoding': 'mono16',
        'width': 4,
        'height': 3,
        'step': 8,
        'is_bigendian': False,
        'data': bytes(24),
    }
    with pytest.raises(ImageRefused) as refused:
        messages.decode_image(**{**fields, **change}, time_ns=TIME_NS)
    assert refused.value.reason == reason
    assert detail in refused.value.detail
    assert len(refused.value.detail) < 200


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_png(dtype: Any) -> None:
    pixels = RAMP.astype(dtype)
    data = array.array('B', cv2.imencode('.png', pixels)[1].tobytes())
    header = messages.make_header(TIME_NS, '', plain)
    image = messages.image_from_message(SimpleNamespace(header=header, data=data), 1e-9)
    assert image.time_ns == TIME_NS + 1
    np.testing.assert_array_equal(image.pixels, pixels, strict=True)


@pytest.mark.parametrize(
    ('data', 'reason'),
    [
        (b'', 'bad_encoding'),
        (cv2.imencode('.jpg', RAMP.astype(np.uint8))[1].tobytes(), 'bad_encoding'),
        (cv2.imencode('.png', np.zeros((2, 2, 3), np.uint8))[1].tobytes(), 'bad_encoding'),
        (cv2.imencode('.png', RAMP)[1].tobytes()[:20], 'bad_layout'),
    ],
)
def test_png_refusals(data: bytes, reason: str) -> None:
    with pytest.raises(ImageRefused) as refused:
        messages.decode_png(array.array('B', data), TIME_NS)
    assert refused.value.reason == reason


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_image_round_trip(make: Any, dtype: Any) -> None:
    """An image written is the image read, its time shifted by the stamp offset."""
    image = Image(TIME_NS, RAMP.astype(dtype))
    message = messages.image_to_message(image, 'camera', make)
    assert message.header.frame_id == 'camera'
    back = messages.image_from_message(message, stamp_offset_s=-0.025)
    assert back.time_ns == TIME_NS - 25_000_000
    assert back.pixels.dtype == dtype
    np.testing.assert_array_equal(back.pixels, image.pixels)


@pytest.mark.parametrize('time_ns', [0, 1, 999_999_999, TIME_NS, -1])
def test_stamps_are_exact(time_ns: int) -> None:
    """A stamp keeps every nanosecond, before 1970 too."""
    header = messages.make_header(time_ns, '', plain)
    assert 0 <= header.stamp.nanosec < 10**9
    assert messages.stamp_ns(header.stamp) == time_ns


def test_attitude_and_velocity_round_trip() -> None:
    """Components come back in their own places."""
    message = messages.attitude_to_message(5, np.array([0.1, 0.2, 0.3, 0.4]), 'icrf', plain)
    assert (message.quaternion.w, message.header.frame_id) == (0.4, 'icrf')
    time_ns, xyzw = messages.attitude_from_message(message)
    assert time_ns == 5
    np.testing.assert_array_equal(xyzw, [0.1, 0.2, 0.3, 0.4])
    message = messages.velocity_to_message(6, np.array([1.0, -2.0, 3e4]), 'icrf', plain)
    time_ns, velocity = messages.velocity_from_message(message)
    assert time_ns == 6
    np.testing.assert_array_equal(velocity, [1.0, -2.0, 3e4])


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_temperature_round_trip(make: Any) -> None:
    message = messages.temperature_to_message(7, -12.5, 'camera', make)
    assert messages.temperature_from_message(message) == (7, -12.5)
    # A sensor that has failed says inf or NaN: not known.
    message = messages.temperature_to_message(7, np.inf, 'camera', make)
    assert np.isnan(messages.temperature_from_message(message)[1])


def observations(n: int = 5) -> StarObservations:
    """Observations of n stars with a different number in every place."""
    random = np.random.default_rng(3)
    directions = random.normal(size=(n, 3))
    return dataclasses.replace(
        refused_image(TIME_NS, 1296, 1024, '', ''),
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
        refused_catalog_id=np.array([2**62 + 20, -5, 7, 8], np.int64),
        refused_px=random.uniform(0, 1000, (4, 2)).astype(np.float32),
        refused_reason=np.array([0, 1, 0, 0], np.uint8),
    )


def calibration() -> Calibration:
    """A calibration with a different number in every place."""
    parameters = [3641.5, -0.74, 3642.3, 647.5, 511.5, -0.051, 0.117, 0.01, 5.1e-4, 3.2e-4]
    camera = CameraModel(1296, 1024, np.array(parameters))
    return Calibration(
        time_ns=TIME_NS,
        geometry=CameraGeometry(camera, np.array([0.1, -0.7, 0.1, 0.7])),
        covariance=np.arange(169.0).reshape(13, 13) / 7,
        method='hierarchical',
        estimated=('fx', 'fy'),
        residual_rms_px=0.101,
        variance_factor=1.02,
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
        provenance={'catalog': 'x', 'version': '1'},
        thermal=Thermal(
            21.5, (4e-5, -6e-7), (1e-6, 2e-8), (1e-5, 2e-5, 3e-5), (1e-6, 2e-6, 3e-6), 'a word'
        ),
        maps=DetectorMaps(
            np.arange(6).reshape(2, 3),
            np.arange(12.0).reshape(4, 3) / 7,
            np.sqrt(np.arange(12.0)).reshape(4, 3),
        ),
        correlation=Correlation(('fx', 'fy'), np.array([[1.0, 1 / 3], [1 / 3, 1.0]])),
        removals=(
            Removal('', 0.0, 0.0, 0.0, True, 0.1, (0.09, 0.11), 0.0),
            Removal('k3', -0.3, 0.5, 1 / 7, False, 0.3, (0.25, 0.35), 1e-9),
        ),
    )


def assert_same(a: Any, b: Any) -> None:
    """Every field equal, arrays with type and shape."""
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            assert_same(x, y)
        elif isinstance(x, float) and np.isnan(x):
            assert np.isnan(y), field.name
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name, strict=True)
        else:
            assert x == y, field.name
            assert type(x) is type(y) or isinstance(x, float), field.name


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_records_round_trip(make: Any) -> None:
    """Every number of a record survives its message, bit for bit."""
    record = observations()
    assert_same(
        record,
        messages.observations_from_message(messages.observations_to_message(record, 'cam', make)),
    )
    refused = refused_image(TIME_NS, 1, 2, 'no_stars', 'three')
    assert_same(
        refused,
        messages.observations_from_message(messages.observations_to_message(refused, 'cam', make)),
    )
    for terms in (calibration().thermal, None, Thermal(20.0, note='left out')):
        result = dataclasses.replace(calibration(), thermal=terms)
        assert_same(
            result,
            messages.calibration_from_message(messages.calibration_to_message(result, make)),
        )
    silent = dataclasses.replace(calibration(), maps=None, correlation=None, removals=())
    assert_same(
        silent, messages.calibration_from_message(messages.calibration_to_message(silent, make))
    )
    status = EnsembleStatus(
        time_ns=TIME_NS,
        images=3,
        stars=40,
        min_images=5,
        min_stars=100,
        refused={'no_match': 1},
        coverage=np.arange(12).reshape(3, 4),
        parameter_names=('fx', 'fy'),
        predicted_sigma=np.array([1.5, np.inf]),
    )
    assert_same(
        status, messages.status_from_message(messages.status_to_message(status, 'cam', make))
    )


@pytest.mark.parametrize(
    ('field', 'value', 'text'),
    [
        ('measured_px', np.zeros(9), 'measured_px: 9 numbers, not 5 x 2'),
        ('measured_px', np.full(10, np.nan), 'measured_px: not finite'),
        ('covariance_px2', np.zeros(15), 'not positive definite'),
        ('refused_star_counts', np.zeros(1, np.uint32), '2 reasons but 1 counts'),
        ('refused_star_px', np.zeros(7), 'refused_star_px: 7 numbers, not 4 x 2'),
        ('refused_star_px', np.full(8, np.inf), 'refused_px: not finite'),
        ('refused_star_reason', np.full(4, 2), 'refused_star_reason: 2 is none of 2 reasons'),
    ],
)
def test_bad_observations_are_refused(field: str, value: Any, text: str) -> None:
    """Observations that do not fit together are refused by the name of the field."""
    message = messages.observations_to_message(observations(), 'cam', plain)
    setattr(message, field, value)
    with pytest.raises(ValueError, match=text):
        messages.observations_from_message(message)


def test_refused_stars_are_found_by_reason() -> None:
    record = observations()
    places = record.refused_places()
    assert list(places) == ['blend', 'saturated']
    np.testing.assert_array_equal(places['blend'], record.refused_px[[0, 2, 3]])
    np.testing.assert_array_equal(places['saturated'], record.refused_px[[1]])


def test_older_recordings_are_read() -> None:
    """Fields that were added since are as if nothing was known."""
    message = messages.observations_to_message(observations(), 'cam', plain)
    del message.temperature_degc
    del message.refused_star_id, message.refused_star_px, message.refused_star_reason
    record = messages.observations_from_message(message)
    assert np.isnan(record.temperature_degc)
    assert record.refused_stars == {'blend': 3, 'saturated': 1}
    assert record.refused_px.shape == (0, 2)
    message = messages.calibration_to_message(calibration(), plain)
    del message.reference_temperature_degc, message.coverage_rows, message.correlation_names
    del message.removal_removed
    found = messages.calibration_from_message(message)
    assert found.thermal is None and found.maps is None and found.correlation is None
    assert found.removals == ()


@pytest.mark.parametrize(
    ('field', 'text'),
    [
        ('coverage', 'coverage: 1 numbers, not 2 x 3'),
        ('line_of_sight_sigma_arcsec', 'line_of_sight_sigma_arcsec: 1 numbers, not 4 x 3'),
        ('shape_sigma_arcsec', 'shape_sigma_arcsec: 1 numbers, not 4 x 3'),
        ('correlation', 'correlation: 1 numbers, not 2 x 2'),
        ('removal_wald', 'removal_wald: 1 numbers, not 2'),
        ('removal_within_chance', 'removal_within_chance: 1 numbers, not 2'),
    ],
)
def test_grids_of_another_size_are_refused(field: str, text: str) -> None:
    message = messages.calibration_to_message(calibration(), plain)
    setattr(message, field, np.zeros(1))
    with pytest.raises(ValueError, match=text):
        messages.calibration_from_message(message)


@pytest.mark.parametrize(
    ('field', 'text'),
    [
        ('focal_per_degc_sigma', 'focal_per_degc_sigma: 1 numbers, not 2'),
        ('alignment_rate_rad_per_degc', 'alignment_rate_rad_per_degc: 1 numbers, not 3 or none'),
        ('alignment_rate_rad_per_degc_sigma', '1 numbers, not 3'),
    ],
)
def test_bad_terms_of_temperature_are_refused(field: str, text: str) -> None:
    message = messages.calibration_to_message(calibration(), plain)
    setattr(message, field, np.zeros(1))
    with pytest.raises(ValueError, match=text):
        messages.calibration_from_message(message)


def test_empty_calibration_is_refused() -> None:
    """The calibration of an answer without solution is not taken for a camera."""
    message = messages.calibration_to_message(calibration(), plain)
    message.parameter_names = []
    with pytest.raises(ValueError, match='none are not the thirteen'):
        messages.calibration_from_message(message)


def test_camera_info_projects_like_the_calibration() -> None:
    """What a ROS reader makes of camera_info is the camera, to the cost the calibration names."""
    record = calibration()
    message = messages.camera_info_to_message(record, make_message)
    assert message.distortion_model == 'plumb_bob'
    assert (message.width, message.height) == (1296, 1024)
    assert message.k[1] == 0.0
    np.testing.assert_array_equal(message.p.reshape(3, 4)[:, :3], message.k.reshape(3, 3))
    camera = record.geometry.camera
    pixels = np.array([[0.0, 0.0], [647.5, 511.5], [1295.0, 1023.0], [1295.0, 0.0]])
    directions = line_of_sight(camera, pixels)
    seen, _ = cv2.projectPoints(
        directions, np.zeros(3), np.zeros(3), message.k.reshape(3, 3), message.d
    )
    # A skew of -0.74 over a field of +-0.14 is a tenth of a pixel at the corners.
    assert np.abs(seen[:, 0] - project(camera, directions)).max() < 0.15


def test_alignment_message() -> None:
    """The child is the camera, the rotation takes its coordinates to the star tracker's."""
    message = messages.alignment_to_message(calibration(), plain)
    assert (message.header.frame_id, message.child_frame_id) == ('st', 'cam')
    assert message.transform.rotation.y == -0.7
