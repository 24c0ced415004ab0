# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Facts of photographs by their EXIF tags and FITS headers, written by Pillow and Astropy."""

import bz2
import calendar
from collections.abc import Callable, Mapping
import io
import math
import os
from pathlib import Path
import struct
import time

from astropy.io import fits
import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin
import pytest

from starcal_ground.images.image_series import (
    common_scale,
    FileFacts,
    ImageOptions,
    look,
    pixels_of,
)
from starcal_ground.images.photographs import (
    by_camera,
    image_paths,
    in_order,
    look_at,
    Photograph,
    pixels_of_photograph,
    Refusals,
)
from starcal_ros.errors import IngestError

TIME_S = calendar.timegm((2024, 3, 9, 22, 10, 4))
EXIF, GPS = 0x8769, 0x8825
CANON: Mapping[int, object] = {0x010F: 'Canon', 0x0110: 'EOS'}
DATE: Mapping[int, object] = {0x9003: '2024:03:09 23:10:00', 0x9011: '+01:00', 0x829A: 8.0}


def jpeg(
    path: Path,
    tags: Mapping[int, object],
    of_exif: Mapping[int, object],
    gps: Mapping[int, object] | None = None,
) -> Path:
    exif = Image.Exif()
    exif.update({**tags, EXIF: dict(of_exif), GPS: dict(gps or {})})
    Image.new('RGB', (60, 40), (10, 60, 110)).save(path, exif=exif, quality=95)
    return path


def test_focal_length_is_by_the_pixels_of_the_sensor_or_that_of_35_mm_film(tmp_path) -> None:
    by_film = 24 / math.hypot(36, 24) * math.hypot(60, 40)  # the diagonals
    one = look_at(jpeg(tmp_path / 'a.jpg', CANON, {0xA405: 24}))
    assert one.focal_px == pytest.approx(by_film, rel=1e-4)
    assert math.isnan(look_at(jpeg(tmp_path / 'b.jpg', CANON, {0xA405: 0})).focal_px)
    # 6000 pixels at 2540 a centimetre, in inches; this image is at a hundredth of that.
    tags: dict[int, object] = {0x920A: 50.0, 0xA20E: 6451.6, 0xA210: 2, 0xA002: 6000, 0xA405: 80}
    one = look_at(jpeg(tmp_path / 'a.jpg', CANON, tags))
    assert one.focal_px == pytest.approx(50.0 / (25.4 / 6451.6 * 100), rel=1e-4)
    for alone, words in (
        ((20.0, 0.0), '--focal-length-mm needs --pixel-size-um: the file does not'),
        ((0.0, 4.0), '--pixel-size-um needs --focal-length-mm: the file does not state it'),
        ((1e-9, 5.0), '--focal-length-mm and --pixel-size-um give .* 2e-07 px'),
    ):
        with pytest.raises(IngestError, match=words):
            look_at(jpeg(tmp_path / 'none.jpg', CANON, {}), *alone)
    given = look_at(tmp_path / 'a.jpg', focal_length_mm=20.0, pixel_um=4.0)
    assert given.focal_px == pytest.approx(5000.0)


def test_the_stamp_is_the_middle_of_the_exposure_in_utc(tmp_path) -> None:
    one = look_at(jpeg(tmp_path / 'a.jpg', CANON, DATE))
    assert (one.time_ns, one.dated, one.utc) == (TIME_S * 10**9, True, True)
    local = look_at(jpeg(tmp_path / 'b.jpg', CANON, {**DATE, 0x9011: ''}))
    assert (local.time_ns, local.utc) == ((TIME_S + 3600) * 10**9, False)
    never_set = jpeg(tmp_path / 'c.jpg', CANON, {0x9003: '1980:01:01 00:00:00'})
    os.utime(never_set, (TIME_S, TIME_S))
    assert look_at(never_set).time_ns == TIME_S * 10**9
    assert not look_at(never_set).dated


def test_a_stated_time_and_flip_replace_those_of_a_file(tmp_path) -> None:
    facts = FileFacts({'c.jpg': TIME_S * 10**9}, 'top-bottom')
    for path in (
        jpeg(tmp_path / 'c.jpg', CANON, {}),
        jpeg(tmp_path / 'c.jpg', CANON, {**DATE, 0x9011: ''}),
    ):
        one = look_at(path, facts=facts)
        assert (one.time_ns, one.dated, one.utc) == (TIME_S * 10**9, True, True)
        assert (one.flip, one.pixels_of) == ('top-bottom', 'mirrored top to bottom (--flip)')
    with pytest.raises(IngestError, match='not in the table of --times'):
        look_at(jpeg(tmp_path / 'd.jpg', CANON, DATE), facts=facts)


def test_gps_tags_are_the_site(tmp_path) -> None:
    gps: dict[int, object] = {
        1: 'S', 2: (33.0, 27.0, 30.0), 3: 'W', 4: (70.0, 40.0, 12.0), 5: b'\0', 6: 520.0,
    }  # fmt: skip
    site = look_at(jpeg(tmp_path / 'a.jpg', CANON, DATE, gps)).site
    assert site == pytest.approx((-(33 + 27.5 / 60), -(70 + 40.2 / 60), 520.0))
    beyond: dict[int, object] = {1: 'S', 2: (95.0, 0.0, 0.0)}
    assert look_at(jpeg(tmp_path / 'b.jpg', CANON, DATE, beyond)).site is None


def test_portrait_is_the_image_of_the_sensor_and_cameras_are_told_apart(tmp_path) -> None:
    flat = look_at(jpeg(tmp_path / 'a.jpg', CANON, {0x920A: 50.0}))
    upright = look_at(jpeg(tmp_path / 'b.jpg', {**CANON, 0x0112: 6}, {0x920A: 50.0}))
    zoomed = look_at(jpeg(tmp_path / 'c.jpg', CANON, {0x920A: 35.0}))
    other = look_at(jpeg(tmp_path / 'd.jpg', CANON, {0x920A: 50.0, 0xA431: '0815'}))
    groups = by_camera([flat, zoomed, upright, other])
    assert list(groups) == [
        'Canon EOS 50 mm 60 x 40',
        'Canon EOS 35 mm 60 x 40',
        'Canon EOS 0815 50 mm 60 x 40',
    ]
    assert pixels_of_photograph(upright.path).shape == (40, 60)


def test_green_light_of_a_colour_image_without_the_curve(tmp_path) -> None:
    cv2.imwrite(str(tmp_path / 'a.png'), np.full((4, 5, 3), (0, 188, 255), np.uint8))
    pixels = pixels_of_photograph(tmp_path / 'a.png')
    # 188 of sRGB is half of the light of white, to 1 %.
    assert pixels.dtype == np.uint16
    assert pixels[0, 0] / 65535 == pytest.approx(0.5, abs=0.005)


def test_files_with_one_time_of_exposure_are_all_kept_the_largest_first(tmp_path) -> None:
    """Eight fields may be exposed in a second; pixels show copies, of which the first is kept."""
    for k in range(8):
        exif = Image.Exif()
        exif.update({**CANON, EXIF: DATE})
        pixels = np.random.default_rng(k).integers(0, 255, (40, 60, 3), np.uint8)
        Image.fromarray(pixels).save(tmp_path / f'{k}.jpg', exif=exif, quality=50 + 5 * k)
    ordered = in_order([look_at(path) for path in image_paths([tmp_path])])
    assert [one.path.name for one in ordered] == [f'{k}.jpg' for k in reversed(range(8))]
    assert [one.time_ns // 10**9 - TIME_S for one in ordered] == list(range(8))


def dng(path: Path, mosaic: NDArray[np.uint16]) -> Path:
    """Write a mosaic with red at the top left as DNG 1.4: a TIFF by Pillow, its kind changed."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    one = TiffImagePlugin.IFDRational(1, 1)
    short, byte, text, long_, ratio, signed = 3, 1, 2, 4, 5, 10
    values: dict[int, tuple[int, object]] = {
        306: (text, '2024:03:09 23:10:00'),
        33421: (short, (2, 2)),  # size and colours of the pattern
        33422: (byte, bytes([0, 1, 1, 2])),
        33434: (ratio, TiffImagePlugin.IFDRational(8, 1)),  # s of exposure
        37386: (ratio, TiffImagePlugin.IFDRational(50, 1)),  # mm
        50706: (byte, bytes([1, 4, 0, 0])),
        50708: (text, 'Canon EOS R6'),
        50714: (short, 512),  # black and white level
        50717: (long_, 16383),
        50721: (signed, tuple(one * int(i % 4 == 0) for i in range(9))),
    }
    for tag, (kind, value) in values.items():
        tags.tagtype[tag], tags[tag] = kind, value
    Image.fromarray(mosaic).save(path, format='TIFF', tiffinfo=tags)
    kind_of_picture = struct.Struct('<HHII')
    gray, mosaic_of_colours = (kind_of_picture.pack(262, 3, 1, k) for k in (1, 32803))
    path.write_bytes(path.read_bytes().replace(gray, mosaic_of_colours))
    return path


@pytest.mark.parametrize('zone', ['UTC', 'America/New_York'])
def test_camera_raw_has_the_facts_of_its_tags(tmp_path, zone, monkeypatch) -> None:
    """The clock of the camera has no zone, and that of this machine does not count."""
    pytest.importorskip('rawpy')
    monkeypatch.setenv('TZ', zone)
    time.tzset()
    one = look_at(dng(tmp_path / 'a.DNG', np.full((80, 120), 600, np.uint16)), pixel_um=5.0)
    monkeypatch.undo()
    time.tzset()
    assert (one.width, one.height) == (120, 80)
    assert one.focal_px == pytest.approx(10000.0)
    assert one.time_ns == (calendar.timegm((2024, 3, 9, 23, 10, 0)) + 4) * 10**9
    assert one.dated and not one.utc


def test_green_of_camera_raw_is_linear_in_light(tmp_path) -> None:
    pytest.importorskip('rawpy')
    mosaic = np.full((80, 120), 612, np.uint16)
    mosaic[::2, ::2] = mosaic[1::2, 1::2] = 9000  # red and blue
    mosaic[40, 61] = 4612
    light = pixels_of_photograph(dng(tmp_path / 'a.dng', mosaic)).astype(float)
    # LibRaw rounds each value to an integer before it scales it, and once more.
    unit = 65535 / (16383 - 512)
    assert light[40, 61] == pytest.approx(4100 * unit, abs=2 * unit)
    assert light[10, 10] == light[11, 10] == pytest.approx(100 * unit, abs=2 * unit)
    assert light[40, 62] == pytest.approx((3 * 100 + 4100) / 4 * unit, abs=2 * unit)


def test_a_damaged_raw_file_is_one_line(tmp_path) -> None:
    pytest.importorskip('rawpy')
    path = tmp_path / 'a.nef'
    path.write_bytes(b'II*\0' + b'x' * 5000)
    with pytest.raises(IngestError, match='a.nef: camera raw, not readable: Unsupported file'):
        look_at(path)
    whole = dng(tmp_path / 'b.dng', np.full((80, 120), 600, np.uint16))
    whole.write_bytes(whole.read_bytes()[:-5000])
    with pytest.raises(IngestError, match='b.dng: camera raw, not readable: '):
        pixels_of_photograph(whole)


PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


def encoded(ending: str) -> bytes:
    return cv2.imencode(ending, PIXELS)[1].tobytes()


def read(path: Path) -> Photograph:
    """The facts and then the pixels of a file, as a calibration reads them."""
    photograph = look_at(path)
    pixels_of_photograph(path)
    return photograph


def imported(path: Path) -> None:
    options = ImageOptions({path.name: 1})
    pixels_of(path, options, common_scale([look(path, options)], options))


def sparse(path: Path, start: bytes, size: int) -> None:
    with path.open('wb') as file:
        file.write(start)
        file.truncate(size)


def content(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


def encoded_fits() -> bytes:
    stream = io.BytesIO()
    fits.PrimaryHDU(PIXELS[:, :, 0]).writeto(stream)
    return stream.getvalue()


TABLE = fits.BinTableHDU.from_columns([fits.Column('x', 'D', array=[1.0])])
HUGE = encoded('.png')[:16] + struct.pack('>II', 60000, 60000) + encoded('.png')[24:]
HEIC = b'\0\0\0\x18ftypheic' + bytes(40)
BAD: Mapping[str, tuple[Callable[[Path], object], str]] = {
    'pipe.jpg': (os.mkfifo, 'not a regular file'),
    'endless.jpg': (lambda path: path.symlink_to('/dev/zero'), 'not a regular file'),
    'dangling.jpg': (lambda path: path.symlink_to('nowhere'), 'cannot be read: No such file'),
    'loop.jpg': (lambda path: path.symlink_to(path), 'cannot be read: Too many levels'),
    'folder.jpg': (Path.mkdir, 'a folder: give it too, or leave it out'),
    'zeros.jpg': (lambda path: sparse(path, b'', 20 << 30), 'no image that is read'),
    'sparse.jpg': (lambda path: sparse(path, b'\xff\xd8\xff', 20 << 30), 'larger than 512 MB'),
    'sparse.png': (lambda path: sparse(path, encoded('.png'), 20 << 30), 'larger than 512 MB'),
    'sparse.tif': (lambda path: sparse(path, encoded('.tiff'), 20 << 30), 'larger than 512 MB'),
    'sparse.fits': (lambda path: sparse(path, b'SIMPLE  =', 20 << 30), 'not readable as FITS'),
    'junk.jpg': (lambda path: sparse(path, b'\xff\xd8\xff', 400 << 20), 'damaged'),
    'half.jpg': (content(encoded('.jpg')[:2000]), 'damaged'),
    'half.png': (content(encoded('.png')[:2000]), 'damaged'),
    'half.tif': (content(encoded('.tiff')[:200]), 'damaged'),
    'half.bmp': (content(encoded('.bmp')[:2000]), 'damaged'),
    'huge.png': (content(HUGE), 'a PNG, not readable: damaged'),
    'empty.jpg': (content(b''), 'no image that is read'),
    'notes.txt': (content(b'clouds'), 'no image that is read, by its content: FITS'),
    'a.HEIC': (content(HEIC), 'no image that is read'),
    'renamed.jpg': (content(HEIC), 'no image that is read'),
    'cube.fits': (lambda path: fits.PrimaryHDU(np.zeros((8, 9, 10))).writeto(path), 'each image'),
    'pages.tif': (lambda path: cv2.imwritemulti(str(path), [PIXELS, PIXELS]), 'each image'),
    'cut.fits': (content(encoded_fits()[:4000]), 'not readable as FITS|damaged'),
    'table.fits': (TABLE.writeto, 'no image'),
    'bag.mcap': (content(b'\x89MCAP0\r\n' + bytes(40)), 'an MCAP bag: calibrate it by itself'),
}


@pytest.mark.parametrize('name', BAD)
def test_a_file_that_is_no_sound_photograph_is_refused_with_reason(name, tmp_path, capfd) -> None:
    make, reason = BAD[name]
    path = tmp_path / name
    make(path)
    with pytest.raises(IngestError, match=reason) as error:
        read(path)
    assert str(error.value).startswith(f'{path}: ') and '\n' not in str(error.value)
    # Nor do the libraries print a line for each file.
    assert ''.join(capfd.readouterr()) == ''
    with pytest.raises(IngestError) as error:
        imported(path)
    assert str(error.value).startswith(f'{path}: ') and '\n' not in str(error.value)


def test_files_left_out_are_counted_by_reason_with_a_few_names() -> None:
    refusals = Refusals()
    for k in range(3000):
        with refusals.of(Path(f'{k}.jpg')):
            raise IngestError(f'{k}.jpg: damaged')
    for k in range(100):
        refusals.add(Path(f'{k}.png'), f'claims {k} pixels')
    lines = refusals.lines()
    assert lines[0] == 'left out: 3000 files (0.jpg, 1.jpg, 2.jpg, ...): damaged'
    assert lines[-1].startswith('left out: 93 files (') and len(lines) == 9


def test_a_folder_is_read_by_content_and_nothing_in_it_is_skipped(tmp_path) -> None:
    for name in ('a.jpg', 'b.HEIC', 'c.dat', 'd.txt'):
        (tmp_path / name).write_bytes(HEIC if name == 'b.HEIC' else encoded('.jpg'))
    (tmp_path / 'd.txt').write_text('clouds')
    (tmp_path / '.DS_Store').write_bytes(b'')
    assert [path.name for path in image_paths([tmp_path])] == ['a.jpg', 'b.HEIC', 'c.dat', 'd.txt']
    assert image_paths([tmp_path / 'd.txt']) == []
    assert image_paths([tmp_path / '*.HEIC']) == [tmp_path / 'b.HEIC']
    with pytest.raises(IngestError, match='no such files'):
        image_paths([tmp_path / '*.NEF'])
    assert read(tmp_path / 'c.dat').width == 60


@pytest.mark.parametrize(('name', 'pack'), [('a.fits', bytes), ('a.fits.bz2', bz2.compress)])
def test_fits_is_read_compressed_and_by_any_name(tmp_path, name, pack) -> None:
    for path in (tmp_path / name, tmp_path / 'renamed'):
        path.write_bytes(pack(encoded_fits()))
        assert (pixels_of_photograph(path) == PIXELS[:, :, 0]).all()


STRANGE: Mapping[str, tuple[Mapping[int, object], Mapping[int, object]]] = {
    'year 2300': ({0x9003: '2300:01:01 00:00:00'}, {}),
    'year 9999': ({0x9003: '9999:12:31 23:59:59', 0x9011: '-14:00'}, {}),
    'exposure of a century': ({0x9003: '2024:01:01 00:00:00', 0x829A: 3e9}, {}),
    'focal length of 1e-9 mm': ({0x920A: 1e-9, 0xA20E: 6451.6, 0xA210: 2}, {}),
    'focal length of 1e9 mm': ({0x920A: 1e9, 0xA405: 60000}, {}),
    '1,000 GPS parts': ({}, {1: 'N', 2: (1.0,) * 1000, 3: 'E', 4: (1.0,) * 1000}),
    'one GPS part': ({}, {1: 'N', 2: 1.0, 3: 'E', 4: 1.0}),
}


@pytest.mark.parametrize('case', STRANGE)
def test_strange_facts_are_facts_that_are_not_known(case, tmp_path) -> None:
    photograph = read(jpeg(tmp_path / 'a.jpg', CANON, *STRANGE[case]))
    assert 631152000 <= photograph.time_ns / 1e9 < 2**31
    assert np.isnan(photograph.focal_px)
    assert photograph.site is None or max(map(abs, photograph.site[:2])) < 1.02
    assert photograph.camera.startswith('Canon EOS')


def test_a_time_of_a_file_outside_of_the_calendar_is_a_time(tmp_path) -> None:
    (tmp_path / 'a.jpg').write_bytes(encoded('.jpg'))
    for seconds in (-(10**9), 2**33):
        os.utime(tmp_path / 'a.jpg', (seconds, seconds))
        assert 631152000 <= look_at(tmp_path / 'a.jpg').time_ns / 1e9 < 2**31
