# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of images and of what comes beside them: layouts, refusals, round trips, stamps."""

import array
import functools
import itertools
import struct
import sys
import tracemalloc
from types import SimpleNamespace
from typing import Any
import zlib

import cv2
import numpy as np
import pytest
from sample_records import attitude_message, plain, TIME_NS  # type: ignore[import-not-found]

from starcal_ground.bag_writer import image_to_message, temperature_to_message, velocity_to_message
from starcal_ros.errors import ImageRefused, IngestError
from starcal_ros.formats.bag.typestore import make_message, typestore
from starcal_ros.formats.image_files import read_image
from starcal_ros.formats.messages.message_codec import (
    ATTITUDE_TYPES,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    make_header,
    RawMessage,
    stamp_ns,
)
from starcal_ros.formats.messages.record_messages import (
    observations_from_message,
    observations_to_message,
)
from starcal_ros.formats.messages.sensor_messages import (
    attitude_from_message,
    BAYER_ENCODINGS,
    CHANNELS,
    decode_compressed,
    decode_image,
    image_from_message,
    image_of,
    jpeg_header,
    latest_at,
    refused_from_message,
    RGB_ENCODINGS,
    temperature_from_message,
    velocity_from_message,
    view_image,
)
from starcal_ros.records import Image, StarObservations

LETTER = {'red': 'r', 'green': 'g', 'blue': 'b'}
RAMP = np.arange(12, dtype=np.uint16).reshape(3, 4) * 257 + 3
ENCODED: bytes = cv2.imencode('.png', RAMP)[1].tobytes()


def raw(encoding: str, width: int, height: int, step: int, big: bool, data: Any) -> Any:
    """Return the fields of a sensor_msgs/Image that are read."""
    sizes = {'width': width, 'height': height, 'step': step}
    return SimpleNamespace(encoding=encoding, is_bigendian=big, data=data, **sizes)


CONTAINERS: tuple[Any, ...] = (bytes, bytearray, memoryview, functools.partial(array.array, 'B'))


@pytest.mark.parametrize('encoding', ['mono8', '8UC1', 'mono16', '16UC1'])
def test_image_layouts(encoding: str) -> None:
    """Either byte order, any row padding and any container give the same native pixels."""
    dtype = np.dtype(np.uint8 if '8' in encoding else np.uint16)
    for big, padding, container in itertools.product((False, True), (0, 1, 6), CONTAINERS):
        rows = RAMP.astype(dtype.newbyteorder('>' if big else '<')).view(np.uint8).reshape(3, -1)
        padded = np.hstack([rows, np.full((3, padding), 0xAA, np.uint8)])
        data = container(padded.tobytes())
        image = decode_image(raw(encoding, 4, 3, padded.shape[1], big, data), TIME_NS)
        assert image.time_ns == TIME_NS
        assert image.pixels.dtype == dtype and image.pixels.dtype.isnative
        np.testing.assert_array_equal(image.pixels, RAMP.astype(dtype))


def test_native_images_are_not_copied() -> None:
    data = np.zeros(1024 * 1296 * 2, np.uint8)
    image = decode_image(raw('mono16', 1296, 1024, 2592, sys.byteorder == 'big', data), 0)
    assert np.shares_memory(image.pixels, data) and not image.pixels.flags.writeable


@pytest.mark.parametrize(
    ('change', 'reason', 'detail'),
    [
        ({'encoding': 'yuv422'}, 'bad_encoding', "'yuv422' is not one of mono8"),
        ({'encoding': 'rgb8'}, 'bad_encoding', 'rgb8 is a colour image: set image_channel'),
        ({'encoding': 'bayer_rggb8'}, 'bad_encoding', 'set image_channel'),
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
    image = raw('mono16', 4, 3, 8, False, bytes(24))
    vars(image).update(change)
    with pytest.raises(ImageRefused) as refused:
        decode_image(image, TIME_NS)
    assert refused.value.reason == reason
    assert detail in refused.value.detail and len(refused.value.detail) < 200


@pytest.mark.parametrize('channel', CHANNELS)
@pytest.mark.parametrize('encoding', list(RGB_ENCODINGS))
def test_a_plane_is_taken_whatever_its_place(encoding: str, channel: str) -> None:
    letters, size = RGB_ENCODINGS[encoding]
    dtype = np.uint8 if size == 1 else np.uint16
    pixels = np.random.default_rng(1).integers(0, 200, (5, 7, len(letters)), dtype)
    padded = np.zeros((5, 7 * len(letters) * size + 3), np.uint8)
    padded[:, :-3] = pixels.reshape(5, -1).view(np.uint8)
    found = decode_image(raw(encoding, 7, 5, padded.shape[1], False, padded.tobytes()), 1, channel)
    expected = pixels[:, :, letters.index(LETTER[channel])]
    assert found.pixels.dtype == dtype and (found.pixels == expected).all()


@pytest.mark.parametrize('channel', CHANNELS)
@pytest.mark.parametrize('encoding', list(BAYER_ENCODINGS))
def test_the_sites_of_a_colour_are_taken(encoding: str, channel: str) -> None:
    letters, size = BAYER_ENCODINGS[encoding]
    # Each pixel holds the letter of its colour: an odd row and column are left over.
    pattern = np.array([ord(letter) for letter in letters], np.uint8).reshape(2, 2)
    mosaic = np.tile(pattern, (3, 4))[:5, :7].astype(np.uint8 if size == 1 else np.uint16)
    step = 7 * size
    found = decode_image(raw(encoding, 7, 5, step, False, mosaic.tobytes()), 1, channel)
    assert found.pixels.shape == (2, 3) and (found.pixels == ord(LETTER[channel])).all()


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_png(dtype: Any) -> None:
    pixels = RAMP.astype(dtype)
    data = array.array('B', cv2.imencode('.png', pixels)[1].tobytes())
    header = make_header(TIME_NS, '', plain)
    image = image_from_message(SimpleNamespace(header=header, data=data), 1e-9)
    assert image.time_ns == TIME_NS + 1
    np.testing.assert_array_equal(image.pixels, pixels, strict=True)


def png(width: int, height: int, raw: bytes = b'') -> bytes:
    """A PNG of 16 bit with any size in its header and any rows."""

    def chunk(name: bytes, data: bytes) -> bytes:
        checked = name + data
        return struct.pack('>I', len(data)) + checked + struct.pack('>I', zlib.crc32(checked))

    header = chunk(b'IHDR', struct.pack('>IIBBBBB', width, height, 16, 0, 0, 0, 0))
    rows = chunk(b'IDAT', zlib.compress(raw or bytes((1 + 2 * 4) * 3)))
    return b'\x89PNG\r\n\x1a\n' + header + rows + chunk(b'IEND', b'')


def test_a_png_of_another_size_is_not_decoded() -> None:
    whole = png(4, 3)
    assert decode_compressed(whole, 7, (4, 3)).pixels.shape == (3, 4)
    for size in ((5, 3), (4, 4)):
        with pytest.raises(ImageRefused, match='wrong_size: image of 4 x 3, prior camera of'):
            decode_compressed(whole, 7, size)
    # 65000 x 65000 of 16 bit would take 8 GB; less than a page is allocated for the refusal.
    tracemalloc.start()
    with pytest.raises(ImageRefused, match='wrong_size'):
        decode_compressed(png(65000, 65000), 7, (640, 512))
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.parametrize(('sec', 'offset_s'), [(-1, 0.0), (0, -1e-9), (2**31 - 1, 1.0)])
def test_a_stamp_that_no_message_can_hold_is_refused(sec: int, offset_s: float) -> None:
    message = image_to_message(Image(0, RAMP), 'camera', make_message)
    message.header.stamp.sec = sec
    with pytest.raises(ImageRefused, match='bad_stamp: .* range of ROS stamps') as caught:
        image_from_message(message, offset_s)
    record = refused_from_message(message, offset_s, caught.value)
    assert record.refusal == 'bad_stamp'
    back = observations_from_message(observations_to_message(record, 'camera', make_message))
    assert back.time_ns == record.time_ns  # it can be written


@pytest.mark.parametrize(
    ('data', 'reason'),
    [
        (b'', 'bad_encoding'),
        (b'\xff\xd8\xff\xc0\0\x11\x08\0\x04\0\x04\x01', 'bad_layout'),
        (b'\xff\xd8\xff\xc0\0\x11\x08\xff\xff\xff\xff\x01', 'bad_layout'),  # claims 65535 x 65535
        (b'\xff\xd8\xff\xe0\0', 'bad_encoding'),
        (cv2.imencode('.jpg', np.zeros((2, 2, 3), np.uint8))[1].tobytes(), 'bad_encoding'),
        (cv2.imencode('.png', np.zeros((2, 2, 3), np.uint8))[1].tobytes(), 'bad_encoding'),
        (ENCODED[:20], 'bad_encoding'),
    ],
)
def test_compressed_refusals(data: bytes, reason: str) -> None:
    with pytest.raises(ImageRefused) as refused:
        decode_compressed(array.array('B', data), TIME_NS)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    ('content', 'words'),
    [
        (png(60000, 60000), 'its header claims 60000 x 60000 pixels'),
        (png(70000, 2), 'its header claims 70000 x 2 pixels'),
        (png(4, 3, bytes(10**7)), 'inflates to far more than its pixels'),
        (ENCODED[:40], 'is cut off'),
        (ENCODED[:-12], 'is cut off'),
        (ENCODED.replace(b'IDAT\x08', b'IDAT\x09'), 'is damaged'),
    ],
)
def test_files_and_messages_refuse_the_same_pictures(tmp_path, content, words, capfd) -> None:
    with pytest.raises(ImageRefused, match=f'bad_layout: PNG: {words}'):
        decode_compressed(content, TIME_NS)
    (tmp_path / 'a.png').write_bytes(content)
    with pytest.raises(IngestError, match=rf'a\.png: {words}'):
        read_image(tmp_path / 'a.png')
    assert capfd.readouterr() == ('', '')  # libpng would print lines of its own


@pytest.mark.parametrize('ending', ['.png', '.jpg'])
def test_a_channel_of_compressed_colour(ending: str) -> None:
    flat = np.full((16, 16, 3), (10, 120, 240), np.uint8)  # blue, green, red
    data = cv2.imencode(ending, flat)[1].tobytes()
    for channel, value in (('blue', 10), ('green', 120), ('red', 240)):
        pixels = decode_compressed(data, TIME_NS, (16, 16), channel).pixels
        assert pixels.shape == (16, 16) and np.abs(pixels.astype(int) - value).max() <= 3
    with pytest.raises(ImageRefused, match='is a colour image: set image_channel'):
        decode_compressed(data, TIME_NS)
    grey = cv2.imencode('.jpg', flat[..., 1])[1].tobytes()
    assert decode_compressed(grey, TIME_NS).pixels.shape == (16, 16)


@pytest.mark.parametrize('frame_id', ['', 'c', 'ca', 'cam', 'camera', 'Ω'])
@pytest.mark.parametrize('little', [True, False])
@pytest.mark.parametrize('type_name', [IMAGE_TYPE, COMPRESSED_TYPE])
def test_a_serialised_image_is_viewed_as_rosbags_reads_it(type_name, little, frame_id) -> None:
    sent = image_to_message(Image(TIME_NS, RAMP), frame_id, make_message)
    if type_name == COMPRESSED_TYPE:
        fields = {'format': 'mono16; png', 'data': np.frombuffer(png(4, 3), np.uint8)}
        sent = make_message(type_name, header=sent.header, **fields)
    whole = bytes(typestore().serialize_cdr(sent, type_name, little_endian=little))
    expected: Any = typestore().deserialize_cdr(whole, type_name)
    message = view_image(RawMessage('/image', type_name, 5, memoryview(whole)))
    stamp = expected.header.stamp
    assert vars(message.header.stamp) == {'sec': stamp.sec, 'nanosec': stamp.nanosec}
    assert message.header.frame_id == frame_id
    assert message.data.obj is whole and message.data == expected.data.tobytes()
    for name in ('height', 'width', 'encoding', 'is_bigendian', 'step'):
        assert getattr(message, name, None) == getattr(expected, name, None)
    # Truncated anywhere, it is refused with the time of its arrival; more behind it is not read.
    for size in range(len(whole)):
        record = image_of(RawMessage('/image', type_name, 5, memoryview(whole[:size])))
        assert isinstance(record, StarObservations)
        assert (record.refusal, record.time_ns) == ('bad_layout', 5)
        assert record.detail == f'/image: {size} bytes are no {type_name}'
    more = image_of(RawMessage('/image', type_name, 5, memoryview(whole + bytes(9))))
    assert isinstance(more, Image) and more.time_ns == TIME_NS


def test_bytes_of_fill_hide_no_frame_of_a_jpeg() -> None:
    """ITU T.81, B.1.1.2: any number of them may come before a marker."""
    content = cv2.imencode('.jpg', np.zeros((12, 20), np.uint8))[1].tobytes()
    at = content.index(b'\xff\xc0')
    padded = content[:at] + b'\xff\xff' + content[at:]
    assert jpeg_header(padded) == jpeg_header(content) == (20, 12, 1)


@pytest.mark.parametrize('time_ns', [0, 1, 999_999_999, TIME_NS, -1])
def test_stamps_are_exact(time_ns: int) -> None:
    """A stamp keeps every nanosecond, before 1970 too."""
    header = make_header(time_ns, '', plain)
    assert 0 <= header.stamp.nanosec < 10**9
    assert stamp_ns(header.stamp) == time_ns


@pytest.mark.parametrize('speed_m_s', [np.nan, np.inf, -np.inf, -3.1e5])
def test_a_velocity_of_no_spacecraft_is_refused(speed_m_s: float) -> None:
    for axis in range(3):
        velocity = np.where(np.arange(3) == axis, speed_m_s, 0.0)
        with pytest.raises(ValueError, match='is faster than any spacecraft: left out'):
            velocity_from_message(velocity_to_message(6, velocity, 'icrf', plain))


def test_temperature_round_trip() -> None:
    message = temperature_to_message(7, -12.5, 'camera', make_message)
    assert temperature_from_message(message) == (7, -12.5)
    # What a sensor says that has failed is not known: it would have each image refused.
    for failed_degc in (np.inf, np.nan, -999.0):
        message = temperature_to_message(7, failed_degc, 'camera', make_message)
        assert np.isnan(temperature_from_message(message)[1])


@pytest.mark.parametrize('kind', ATTITUDE_TYPES)
def test_attitudes_of_each_type_are_read(kind: str) -> None:
    sent = np.array([0.1, 0.7, -0.1, 0.7])
    message = attitude_message(kind, 5, sent)
    time_ns, xyzw = attitude_from_message(message)
    assert time_ns == 5
    np.testing.assert_array_equal(xyzw, sent)
    if kind == IMU_TYPE:
        message.orientation_covariance[0] = -1.0  # sensor_msgs/Imu: orientation not known
        assert np.isnan(attitude_from_message(message)[1]).all()


def test_the_last_sample_at_or_before_an_image_counts() -> None:
    samples = [(10, 'a'), (20, 'b'), (30, 'c')]
    for time_ns, sample in ((5, 'a'), (10, 'a'), (29, 'b'), (30, 'c'), (99, 'c')):
        assert latest_at(samples, time_ns, 'none') == sample
    assert latest_at([], 5, 'none') == 'none'
