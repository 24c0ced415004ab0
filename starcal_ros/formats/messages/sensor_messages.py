# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images of each supported encoding and telemetry of the spacecraft, from messages and back."""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
import contextlib
import math
import operator
import struct
import sys
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar
import zlib

import numpy as np

from starcal_ros import opencv as cv2
from starcal_ros.arrays import AnyArray, Floats
from starcal_ros.camera import MAX_SIDE_PX
from starcal_ros.constants import FASTEST_M_S, MAX_STAMP_NS
from starcal_ros.errors import ImageRefused
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.records import Image, LEAST_DEGC, MOST_DEGC, refused_image, StarObservations

MOST_PIXELS = 2**27  # the largest image takes 256 MB at 16 bit
_SET_CHANNEL = 'is a colour image: set image_channel, e.g. to green'
CHANNELS = ('red', 'green', 'blue')

# Encodings of sensor_msgs/image_encodings: the letters of their channels, and bytes per channel.
_GREY_ENCODINGS = {'mono8': ('', 1), '8UC1': ('', 1), 'mono16': ('', 2), '16UC1': ('', 2)}
RGB_ENCODINGS = {
    f'{letters}{bits}': (letters, bits // 8)
    for letters in ('rgb', 'bgr', 'rgba', 'bgra')
    for bits in (8, 16)
}
BAYER_ENCODINGS = {
    f'bayer_{letters}{bits}': (letters, bits // 8)
    for letters in ('rggb', 'bggr', 'gbrg', 'grbg')
    for bits in (8, 16)
}
_ENCODINGS = {**_GREY_ENCODINGS, **RGB_ENCODINGS, **BAYER_ENCODINGS}
_PNG_START = b'\x89PNG\r\n\x1a\n\0\0\0\rIHDR'
_PNG_HEADER_BYTES = 33
_PNG_CHUNK = struct.Struct('>I4s')  # length, name
_PNG_MOST_CHUNKS = 100_000
_JPEG_MOST_SEGMENTS = 1000
# Colour type -> channels; a palette is decoded to three colours.
_PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
T = TypeVar('T')
_STAMP_NS = operator.itemgetter(0)


def decode_image(message: codec.Message, time_ns: int, channel: str = '') -> Image:
    """
    Pixels of a sensor_msgs/Image in native byte order, without its row padding.

    No copy where the message holds them so already.  Of a mosaic, the image of a colour has half
    the width and height (`of_mosaic`).

    ``data`` is anything with a buffer of bytes; ``channel`` is red, green or blue, or empty, which
    refuses colour images.  Raises ImageRefused ``bad_encoding`` or ``bad_layout``.
    """
    encoding, width, height, step = message.encoding, message.width, message.height, message.step
    data = message.data
    if encoding not in _ENCODINGS:
        raise ImageRefused(
            'bad_encoding', f'{encoding[:40]!r} is not one of {", ".join(_GREY_ENCODINGS)}'
        )
    letters, pixel_bytes = _ENCODINGS[encoding]
    if letters and not channel:
        raise ImageRefused('bad_encoding', f'{encoding} {_SET_CHANNEL}')
    channels = len(letters) if encoding in RGB_ENCODINGS else 1
    # An empty buffer has no shape that frombuffer would take.
    flat = np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    row_bytes = width * pixel_bytes * channels
    if width < 1 or height < 1:
        raise ImageRefused('bad_layout', f'{width} x {height} is not an image')
    if step < row_bytes:
        raise ImageRefused('bad_layout', f'step {step} is less than a row of {row_bytes} bytes')
    if flat.size != step * height:
        raise ImageRefused(
            'bad_layout', f'{flat.size} bytes of data, not {step * height} for {height} rows'
        )
    dtype = np.dtype(np.uint8 if pixel_bytes == 1 else '>u2' if message.is_bigendian else '<u2')
    # Strides rather than a slice: a step need not be a whole number of 16-bit pixels.
    rows: AnyArray = np.ndarray(
        (height, width, channels),
        dtype,
        buffer=flat,
        strides=(step, pixel_bytes * channels, pixel_bytes),
    )
    rows = plane(rows, letters, channel) if encoding in RGB_ENCODINGS else rows[:, :, 0]
    if encoding in BAYER_ENCODINGS:
        rows = of_mosaic(rows, letters, channel)
    pixels: AnyArray = np.ascontiguousarray(rows, dtype.newbyteorder('='))
    pixels.setflags(write=False)
    return Image(time_ns, pixels)


class Header(NamedTuple):
    """Size of an image file, px, and its channels."""

    width: int
    height: int
    channels: int


def png_header(content: bytes) -> Header | None:
    """Header at the start of a PNG (PNG 1.2, section 4.1.1); None if it is not a PNG."""
    if content[:16] != _PNG_START or len(content) < _PNG_HEADER_BYTES:
        return None
    width, height, _, colour = struct.unpack_from('>IIBB', content, 16)
    return Header(width, height, _PNG_CHANNELS.get(colour, 0))


def jpeg_header(content: bytes) -> Header | None:
    """Header of a JPEG (ITU T.81, B.2.2), from its frame; None if it is not a JPEG."""
    if content[:2] != b'\xff\xd8':
        return None
    at = 2
    with contextlib.suppress(struct.error):
        for _ in range(_JPEG_MOST_SEGMENTS):
            mark, code, length = struct.unpack_from('>BBH', content, at)
            if mark != 0xFF:
                break
            if code == 0xFF:  # a byte of fill
                at += 1
                continue
            if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC):  # tables, not a frame
                height, width, channels = struct.unpack_from('>HHB', content, at + 5)
                return Header(width, height, channels)
            at += 2 + length
    return None


def _check_png(content: bytes, header: Header) -> None:
    """
    Raise ValueError for a PNG that is not whole, or that inflates to far more than its pixels.

    A megabyte of compressed data can hold a gigabyte: seconds for nothing.  On a damaged chunk
    libpng would print a line of its own; those that a decoder may skip have a small first letter.
    """
    most = 2 * (2 * header.width * header.channels + 8) * header.height  # 16 bit, interlaced
    inflate, at, size, view = zlib.decompressobj(), 8, 0, memoryview(content)
    for _ in range(_PNG_MOST_CHUNKS):
        if at + _PNG_CHUNK.size > len(content):
            raise ValueError('is cut off')
        length, name = _PNG_CHUNK.unpack_from(content, at)
        end = at + _PNG_CHUNK.size + length
        if end + 4 > len(content):
            raise ValueError('is cut off')
        needed = name[:1].isupper()
        if needed and zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], 'big'):
            raise ValueError('is damaged')
        if name == b'IEND':
            return
        if name == b'IDAT':
            try:
                size += len(inflate.decompress(view[end - length : end], most - size + 1))
            except zlib.error as error:
                raise ValueError('is damaged') from error
            if size > most:
                raise ValueError('inflates to far more than its pixels')
        at = end + 4
    raise ValueError('has too many parts')


def decoded(content: bytes, header: Header | None) -> AnyArray:
    """
    Values of an image file as stored, without the orientation of EXIF; colours as BGR.

    A file of a few kilobytes can claim gigabytes of pixels, so the header is checked first.
    Raises ValueError for a file that claims or holds too much, or that cannot be decoded.
    """
    if header is not None:
        sides = header[:2]
        if min(sides) < 1 or max(sides) > MAX_SIDE_PX or math.prod(sides) > MOST_PIXELS:
            raise ValueError(f'its header claims {sides[0]} x {sides[1]} pixels')
        if png_header(content):
            _check_png(content, header)
    values = None
    with contextlib.suppress(cv2.error):
        values = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError('damaged, or in a format that OpenCV cannot read')
    return np.asarray(values)


def decode_compressed(
    data: Any, time_ns: int, size: tuple[int, int] | None = None, channel: str = ''
) -> Image:
    """
    Pixels of a PNG, 8 or 16 bit, or of a JPEG.

    The header is checked before anything is decoded, against ``size`` (width, height) where that
    is known.  ``channel`` as for `decode_image`.

    Raises ImageRefused ``bad_encoding`` for another format; ``wrong_size``; ``bad_layout`` for an
    image that is not `decoded`.
    """
    content = bytes(data)
    png = png_header(content)
    header, kind = png or jpeg_header(content), 'PNG' if png else 'JPEG'
    if header is None:
        raise ImageRefused('bad_encoding', 'the compressed image is not a PNG or JPEG')
    claimed = (header.width, header.height)
    is_colour = header.channels == 3
    if header.channels not in (1, 3):
        raise ImageRefused('bad_encoding', f'the {kind} has {header.channels} channels, not one')
    if is_colour and not channel:
        raise ImageRefused('bad_encoding', f'the {kind} {_SET_CHANNEL}')
    if size is not None and claimed != size:
        raise ImageRefused(
            'wrong_size', 'image of {} x {}, prior camera of {} x {}'.format(*claimed, *size)
        )
    try:
        pixels = decoded(content, header)
    except ValueError as error:
        raise ImageRefused('bad_layout', f'{kind}: {error}') from error
    if is_colour and pixels.ndim == 3:
        pixels = plane(pixels, 'bgr', channel)
    if pixels.shape != claimed[::-1] or pixels.dtype not in (np.uint8, np.uint16):
        raise ImageRefused(
            'bad_encoding',
            f'the {kind} is {pixels.dtype} of shape {pixels.shape}, not one channel',
        )
    pixels.setflags(write=False)
    return Image(time_ns, pixels)


def image_from_message(
    message: codec.Message,
    stamp_offset_s: float = 0.0,
    size: tuple[int, int] | None = None,
    channel: str = '',
) -> Image:
    """
    Image of a sensor_msgs/Image or CompressedImage, its time shifted to the middle of exposure.

    ``size`` (width, height), where known, is that of the prior camera: a compressed image of
    another is not decoded.  ``channel`` as for `decode_image`.

    Raises ImageRefused ``bad_stamp``, ``bad_encoding``, ``bad_layout`` or ``wrong_size``.
    """
    time_ns = codec.stamp_ns(message.header.stamp) + codec.offset_ns(stamp_offset_s)
    if not 0 <= time_ns <= MAX_STAMP_NS:
        raise ImageRefused('bad_stamp', f'{time_ns} ns is not within the range of ROS stamps')
    if not hasattr(message, 'encoding'):
        return decode_compressed(message.data, time_ns, size, channel)
    return decode_image(message, time_ns, channel)


def view_image(raw: codec.RawMessage) -> codec.Message:
    """
    Fields of a serialised sensor_msgs/Image or CompressedImage; ``data`` views its bytes.

    No other copy of the pixels is made, and the types of no middleware are needed: all
    distributions of ROS 2 have the same two.

    Raises ImageRefused ``bad_layout`` where the bytes are none of both.
    """
    order, at = '<' if any(raw.view[1:2]) else '>', 4

    def number(code: str) -> int:
        nonlocal at
        size = struct.calcsize(code)
        at += -at % size
        (value,) = struct.unpack_from(order + code, raw.view, at)
        at += size
        return int(value)

    def sequence() -> memoryview:
        nonlocal at
        size = number('I')
        at += size
        return raw.view[at - size : at]

    try:
        stamp = SimpleNamespace(sec=number('i'), nanosec=number('I'))
        header = SimpleNamespace(stamp=stamp, frame_id=str(sequence()[:-1], 'utf-8', 'replace'))
        message = SimpleNamespace(header=header)
        if raw.type_name == codec.IMAGE_TYPE:
            message.height, message.width = number('I'), number('I')
            message.encoding = str(sequence()[:-1], 'utf-8', 'replace')
            message.is_bigendian, message.step = number('B'), number('I')
        else:
            sequence()  # the format, which the data state too
        message.data = sequence()
    except struct.error:
        at = len(raw.view) + 1
    if at > len(raw.view):
        detail = f'{raw.topic}: {len(raw.view)} bytes are no {raw.type_name}'
        raise ImageRefused('bad_layout', detail)
    return message


def image_of(
    raw: codec.RawMessage,
    stamp_offset_s: float = 0.0,
    size: tuple[int, int] | None = None,
    channel: str = '',
) -> Image | StarObservations:
    """
    Image of a serialised message; refused observations if it cannot be decoded.

    So is a compressed image of another ``size`` (width, height), where one is given.
    ``channel`` is the colour that is taken of colour images (`image_from_message`).
    """
    try:
        message = view_image(raw)
    except ImageRefused as refused:
        return refused_image(raw.log_time_ns, 0, 0, refused.reason, refused.detail)
    try:
        return image_from_message(message, stamp_offset_s, size, channel)
    except ImageRefused as refused:
        return refused_from_message(message, stamp_offset_s, refused)


def refused_from_message(
    message: codec.Message, stamp_offset_s: float, refused: ImageRefused
) -> StarObservations:
    """Return the record of a message of an image, or of its stars, that cannot be used."""
    time_ns = codec.stamp_ns(message.header.stamp) + codec.offset_ns(stamp_offset_s)
    # A compressed image has no size.
    width, height = (int(getattr(message, side, 0)) for side in ('width', 'height'))
    return refused_image(time_ns, width, height, refused.reason, refused.detail)


def image_to_message(
    time_ns: int, pixels: AnyArray, frame_id: str, make: codec.Make
) -> codec.Message:
    """Return a sensor_msgs/Image, mono8 or mono16 of (height, width), bgr8 of (h, w, 3)."""
    pixels = np.ascontiguousarray(pixels)
    return make(
        codec.IMAGE_TYPE,
        header=codec.make_header(time_ns, frame_id, make),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding='bgr8' if pixels.ndim == 3 else f'mono{8 * pixels.itemsize}',
        is_bigendian=int(sys.byteorder == 'big'),
        step=pixels.strides[0],
        data=pixels.reshape(-1).view(np.uint8),
    )


def plane(pixels: AnyArray, letters: str, channel: str) -> AnyArray:
    """Pixels (h, w) of a channel of an image (h, w, c) whose channels have these letters."""
    return np.ascontiguousarray(pixels[:, :, letters.index(channel[0])])


def of_mosaic(pixels: AnyArray, letters: str, channel: str) -> AnyArray:
    """
    Pixels (h // 2, w // 2) of a colour in a Bayer mosaic (h, w).

    Green is taken from the first of its two sites.  Pixel (u, v) is pixel (2 u + i, 2 v + j) of
    the mosaic, (i, j) the site of the colour in the pattern: the prior camera must be one of this
    image.
    """
    j, i = divmod(letters.index(channel[0]), 2)
    height, width = pixels.shape
    return np.ascontiguousarray(pixels[j : height // 2 * 2 : 2, i : width // 2 * 2 : 2])


def attitude_from_message(message: codec.Message) -> tuple[int, Floats]:
    """
    Stamp and (4,) xyzw of an attitude, as on the wire and unchecked.

    The message is a geometry_msgs/QuaternionStamped, PoseStamped or TransformStamped, or a
    sensor_msgs/Imu; NaN for an Imu that marks its orientation as not known (first covariance -1).
    """
    if hasattr(message, 'quaternion'):
        quaternion = message.quaternion
    elif hasattr(message, 'pose'):
        quaternion = message.pose.orientation
    elif hasattr(message, 'transform'):
        quaternion = message.transform.rotation
    else:
        quaternion = message.orientation
        if message.orientation_covariance[0] == -1.0:
            return codec.stamp_ns(message.header.stamp), np.full(4, math.nan)
    return codec.stamp_ns(message.header.stamp), codec.quaternion_from_message(quaternion)


def velocity_from_message(message: codec.Message) -> tuple[int, Floats]:
    """
    Stamp and (3,) m/s of a geometry_msgs/TwistStamped.

    Raises ValueError for a velocity that no spacecraft has; it is to be left out and counted.
    """
    linear = message.twist.linear
    velocity_m_s = np.array([linear.x, linear.y, linear.z], np.float64)
    if not math.hypot(*velocity_m_s.tolist()) < FASTEST_M_S:
        raise ValueError(
            f'velocity {velocity_m_s.tolist()} m/s is faster than any spacecraft: left out; send'
            ' m/s'
        )
    return codec.stamp_ns(message.header.stamp), velocity_m_s


def temperature_from_message(message: codec.Message) -> tuple[int, float]:
    """Stamp and degrees Celsius of a sensor_msgs/Temperature; NaN where no camera has it."""
    temperature_degc = float(message.temperature)
    known = LEAST_DEGC <= temperature_degc <= MOST_DEGC
    return codec.stamp_ns(message.header.stamp), temperature_degc if known else math.nan


def latest_at(samples: Sequence[tuple[int, T]], time_ns: int, without: T) -> T:
    """
    Last sample at or before a time, else the first after it; ``without`` if there are none.

    ``samples`` are in the order of their stamps.  Within a minute, the velocity of a spacecraft
    changes by under 10 m/s (0.007 arcsec), and the temperature of a camera by less than the
    resolution of its sensor.
    """
    if not samples:
        return without
    return samples[max(0, bisect.bisect_right(samples, time_ns, key=_STAMP_NS) - 1)][1]
