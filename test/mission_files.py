# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of a mission made from the small bag: FITS, CCSDS ephemerides, SPICE kernels."""

from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
import functools
from pathlib import Path
from typing import Any

from astropy.io import fits
import cv2
import erfa
import numpy as np
from offline_time import Time  # type: ignore[import-not-found]
import spiceypy
import yaml

from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader
from starcal_ground.simulation.simulated_bag import ATTITUDE_TOPIC, IMAGE_TOPIC
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import COMPRESSED_TYPE, IMAGE_TYPE, make_header
from starcal_ros.formats.messages.sensor_messages import (
    attitude_from_message,
    velocity_from_message,
)
from starcal_ros.records import Image

TINY = Path(__file__).parents[1] / 'bags/tiny'
FRAME_ID, CLOCK_ID = -999100, -999


@functools.cache
def images() -> tuple[Image, ...]:
    found = reader.read_images([TINY], IMAGE_TOPIC)
    return tuple(image for image in found if isinstance(image, Image))


def frames_of(count: int) -> list[np.ndarray]:
    """Pixels of the first images of the small bag."""
    return [image.pixels for image in images()[:count]]


@functools.cache
def attitudes() -> tuple[tuple[int, np.ndarray], ...]:
    """Stamps and quaternions, icrf_from_star_tracker."""
    raw = reader.read_raw([TINY], [ATTITUDE_TOPIC])
    return tuple(attitude_from_message(reader.decode(message)) for message in raw)


def write_tiny(
    path: Path, frames: Iterable[Image], samples: Iterable[tuple[int, np.ndarray]] | None = None
) -> Path:
    """A bag of images and of attitudes, those of the small bag by default, on its topics."""
    with BagWriter(path) as writer:
        for time_ns, xyzw in attitudes() if samples is None else samples:
            writer.write_attitude(ATTITUDE_TOPIC, time_ns, xyzw, 'icrf')
        for image in frames:
            writer.write_image(IMAGE_TOPIC, image, 'camera')
    return path


def params_with(folder: Path, **changes: Any) -> Path:
    """Write a parameter file of the small bag with changed values; None takes one out."""
    content = yaml.safe_load((TINY / 'params.yaml').read_text())
    values = content['/**']['ros__parameters'] | {'camera_info_url': str(TINY / 'camera.yaml')}
    values = {name: value for name, value in (values | changes).items() if value is not None}
    content['/**']['ros__parameters'] = values
    path = folder / 'params.yaml'
    path.write_text(yaml.safe_dump(content))
    return path


def write_velocities(path: Path) -> Path:
    """A table of the velocities of the small bag."""
    raws = reader.read_raw([TINY], ['/spacecraft/velocity'])
    lines = ['time_ns,vx_m_s,vy_m_s,vz_m_s']
    for raw in raws:
        time_ns, velocity_m_s = velocity_from_message(reader.decode(raw))
        lines.append(','.join(map(repr, [time_ns, *velocity_m_s.tolist()])))
    path.write_text('\n'.join(lines) + '\n')
    return path


def date(time_ns: int, system: str = 'utc') -> str:
    """Date and time in a time system, to the nanosecond, by astropy."""
    days, rest_ns = divmod(time_ns, 86400 * 10**9)
    time = Time(40587 + days, rest_ns / (86400 * 10**9), format='mjd', scale='utc')
    if system == 'gps':  # astropy has no such scale: TAI less 19 s
        time = Time(time.tai.jd1, time.tai.jd2 - 19 / 86400, format='jd', scale='tai')
        return str(Time(time, format='isot', precision=9).value)
    return str(Time(getattr(time, system), format='isot', precision=9).value)


def write_frames(folder: Path, count: int = 1) -> None:
    """The first images of the small bag as PNG, their times, and attitudes about them, as CSV."""
    write_pngs(folder, frames_of(count))
    stamps_ns = [image.time_ns for image in images()[:count]]
    times = [f'{k}.png,{time_ns}' for k, time_ns in enumerate(stamps_ns)]
    (folder / 'times.csv').write_text('\n'.join(['file,time_ns', *times, '']))
    around_ns = [time_ns + after_ns for time_ns in stamps_ns for after_ns in (-(10**8), 10**8)]
    rows = [f'{time_ns},0,0,0,1' for time_ns in around_ns]
    (folder / 'attitude.csv').write_text('\n'.join(['time_ns,qx,qy,qz,qw', *rows, '']))


def write_pngs(folder: Path, frames: Sequence[np.ndarray]) -> Path:
    """A folder of images as ``0.png``, ``1.png``, ..."""
    folder.mkdir()
    for k, pixels in enumerate(frames):
        cv2.imwrite(str(folder / f'{k}.png'), pixels)
    return folder


def write_encoded(
    writer: BagWriter, topic: str, image: Image, encoding: str, pixels: np.ndarray
) -> None:
    """Write an image to a bag with other pixels, in an encoding that may be none that is read."""
    height, width = image.pixels.shape
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    message = make_message(
        IMAGE_TYPE, header=make_header(image.time_ns, 'camera', make_message), height=height,
        width=width, encoding=encoding, is_bigendian=0, step=len(data) // height, data=data,
    )  # fmt: skip
    writer.write(topic, IMAGE_TYPE, image.time_ns, message)


def write_compressed(
    writer: BagWriter, topic: str, image: Image, ending: str, pixels: np.ndarray
) -> None:
    """Write a CompressedImage of other pixels with the time of an image, encoded by OpenCV."""
    coded = np.asarray(cv2.imencode(f'.{ending}', pixels)[1]).ravel()
    header = make_header(image.time_ns, 'camera', make_message)
    message = make_message(COMPRESSED_TYPE, header=header, format=ending, data=coded)
    writer.write(topic, COMPRESSED_TYPE, image.time_ns, message)


def write_unread(writer: BagWriter, topic: str, type_name: str) -> None:
    """Write an empty message of a type, which may be unknown: it is named, and never decoded."""
    own: Any = writer._writer
    schema = own.register_schema(type_name, 'ros2msg', b'int8 x')
    own.add_message(own.register_channel(topic, 'cdr', schema), 1, b'', 1)


def write_fits(path: Path, image: Image, kind: str = 'uint16', **header: object) -> Path:
    """A FITS file of an image: uint16, tiled (Rice), float32 in electrons, or an extension."""
    pixels = image.pixels
    values = pixels.astype('f4') * 2.5 - 100.0 if kind == 'float32' else pixels
    made = fits.CompImageHDU(values) if kind == 'tiled' else fits.ImageHDU(values)
    units: list = [fits.PrimaryHDU(), made]
    if kind in ('uint16', 'float32'):
        units = [fits.PrimaryHDU(values)]
    keys = header or {'DATE-AVG': date(image.time_ns)}
    for key, value in keys.items():
        units[-1].header[key] = value
    fits.HDUList(units).writeto(path, overwrite=True)
    return path


def write_aem(path: Path, system: str = 'utc', frame: str = 'ICRF', version: str = '1.0') -> Path:
    """An AEM of the small bag in KVN, written by hand from CCSDS 504.0-B."""
    lines = [
        f'CCSDS_AEM_VERS = {version}',
        'CREATION_DATE = 2026-05-15T07:00:00',
        'ORIGINATOR = TEST',
        'META_START',
        'OBJECT_NAME = MSN',
        'OBJECT_ID = 2026-001A',
        'CENTER_NAME = EARTH',
        f'REF_FRAME_A = {frame}',
        'REF_FRAME_B = STARTRACKER_1',
        *(['ATTITUDE_DIR = A2B'] if version == '1.0' else []),
        f'TIME_SYSTEM = {system.upper()}',
        f'START_TIME = {date(attitudes()[0][0], system)}',
        f'STOP_TIME = {date(attitudes()[-1][0], system)}',
        'ATTITUDE_TYPE = QUATERNION',
        *(['QUATERNION_TYPE = LAST'] if version == '1.0' else []),
        'META_STOP',
        'DATA_START',
    ]
    for time_ns, xyzw in attitudes():
        numbers = ' '.join(map(repr, xyzw.tolist()))
        lines.append(f'{date(time_ns, system)} {numbers}')
    path.write_text('\n'.join([*lines, 'DATA_STOP']) + '\n')
    return path


def write_lsk(path: Path) -> Path:
    """A leap seconds kernel with the table of ERFA and the constants of NAIF."""
    names = 'JAN FEB MAR APR MAY JUN JUL AUG SEP OCT NOV DEC'.split()  # noqa: SIM905
    rows = [
        f'{round(float(row["tai_utc"]))}, @{row["year"]}-{names[row["month"] - 1]}-1'
        for row in erfa.leap_seconds.get()
        if row['year'] >= 1972
    ]
    path.write_text(
        'KPL/LSK\n\\begindata\nDELTET/DELTA_T_A = 32.184\nDELTET/K = 1.657D-3\n'
        'DELTET/EB = 1.671D-2\nDELTET/M = ( 6.239996D0 1.99096871D-7 )\nDELTET/DELTA_AT = ( '
        + '\n'.join(rows)
        + ' )\n\\begintext\n'
    )
    return path


def write_sclk(path: Path) -> Path:
    """A clock of 10^4 ticks a second that counts TDB seconds from 2026-01-01."""
    start = 820497600.0  # TDB seconds past J2000 of 2026-01-01T12:00 TDB less half a day, whole
    path.write_text(
        'KPL/SCLK\n\\begindata\nSCLK_KERNEL_ID = ( @2026-01-01 )\n'
        'SCLK_DATA_TYPE_999 = ( 1 )\nSCLK01_TIME_SYSTEM_999 = ( 1 )\nSCLK01_N_FIELDS_999 = ( 2 )\n'
        'SCLK01_MODULI_999 = ( 4294967296 10000 )\nSCLK01_OFFSETS_999 = ( 0 0 )\n'
        'SCLK01_OUTPUT_DELIM_999 = ( 1 )\nSCLK_PARTITION_START_999 = ( 0 )\n'
        'SCLK_PARTITION_END_999 = ( 4.0E13 )\n'
        f'SCLK01_COEFFICIENTS_999 = ( 0 {start} 1 )\n\\begintext\n'
    )
    return path


def ephemeris_time(time_ns: int) -> float:
    """TDB seconds past J2000 by SPICE, whose leap seconds kernel must be loaded."""
    whole, rest_ns = divmod(time_ns, 10**9)
    text = datetime.fromtimestamp(whole, timezone.utc).strftime('%Y-%m-%dT%H:%M:%S')
    return float(spiceypy.str2et(text)) + rest_ns * 1e-9


def write_ck(folder: Path) -> list[Path]:
    """CK (type 3, linear), SCLK and LSK with the attitudes of the small bag."""
    clock, leap = write_sclk(folder / 'clock.tsc'), write_lsk(folder / 'leap.tls')
    kernels = [folder / 'attitude.bc', clock, leap]
    spiceypy.kclear()
    for kernel in kernels[1:]:
        spiceypy.furnsh(str(kernel))
    ticks = np.array([spiceypy.sce2c(CLOCK_ID, ephemeris_time(t)) for t, _ in attitudes()])
    # A C-matrix takes inertial to frame coordinates: the conjugate, scalar first.
    q = np.array([[xyzw[3], *-xyzw[:3]] for _, xyzw in attitudes()])
    handle = spiceypy.ckopn(str(kernels[0]), 'starcal test', 0)
    spiceypy.ckw03(
        handle, ticks[0], ticks[-1], FRAME_ID, 'J2000', False, 'test', len(ticks),
        ticks, q, np.zeros((len(ticks), 3)), 1, ticks[:1],
    )  # fmt: skip
    spiceypy.ckcls(handle)
    spiceypy.kclear()
    return kernels


def write_spk(path: Path, lsk: Path, velocity_km_s: list[float]) -> Path:
    """An SPK of a body that moves evenly about the barycentre, over the small bag."""
    spiceypy.kclear()
    spiceypy.furnsh(str(lsk))
    first, last = (ephemeris_time(attitudes()[k][0]) for k in (0, -1))
    times = np.linspace(first - 10, last + 10, 10)
    position = np.array([1.5e8, 0.0, 0.0]) + np.outer(times - first, velocity_km_s)
    states = np.c_[position, np.tile(velocity_km_s, (10, 1))]
    handle = spiceypy.spkopn(str(path), 'starcal test', 0)
    spiceypy.spkw09(
        handle, CLOCK_ID, 0, 'J2000', times[0], times[-1], 'test', 3, len(times), states, times
    )
    spiceypy.spkcls(handle)
    spiceypy.kclear()
    return path
