# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files that are no photographs, or damaged ones: each costs its reason, not the run."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Mapping
import io
import os
from pathlib import Path
import struct

from astropy.io import fits
import cv2
import numpy as np
from PIL import Image
import pytest

from starcal_ground.images.photographs import (
    image_paths,
    look_at,
    Photograph,
    pixels_of_photograph,
    Refusals,
)
from starcal_ros.errors import IngestError

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
EXIF, GPS = 0x8769, 0x8825
CANON: Mapping[int, object] = {0x010F: 'Canon', 0x0110: 'EOS'}


def encoded(ending: str) -> bytes:
    return cv2.imencode(ending, PIXELS)[1].tobytes()


def read(path: Path) -> Photograph:
    """The facts and then the pixels of a file, as a calibration reads them."""
    photograph = look_at(path)
    pixels_of_photograph(path)
    return photograph


def sparse(path: Path, start: bytes, size: int) -> None:
    with path.open('wb') as file:
        file.write(start)
        file.truncate(size)


def content(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


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
    'empty.jpg': (content(b''), 'no image that is read'),
    'notes.txt': (content(b'clouds'), 'no image that is read, by its content: FITS'),
    'a.HEIC': (content(HEIC), 'no image that is read'),
    'renamed.jpg': (content(HEIC), 'no image that is read'),
    'cube.fits': (lambda path: fits.PrimaryHDU(np.zeros((8, 9, 10))).writeto(path), 'each image'),
    'pages.tif': (lambda path: cv2.imwritemulti(str(path), [PIXELS, PIXELS]), 'each image'),
    'bag.mcap': (content(b'\x89MCAP0\r\n' + bytes(40)), 'an MCAP bag: calibrate it by itself'),
}


@pytest.mark.parametrize('name', BAD)
def test_a_file_that_is_no_sound_photograph_is_refused_with_its_reason(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    make, reason = BAD[name]
    path = tmp_path / name
    make(path)
    with pytest.raises(IngestError, match=reason) as error:
        read(path)
    assert str(error.value).startswith(f'{path}: ') and '\n' not in str(error.value)
    # Nor do the libraries print a line for each file.
    assert ''.join(capfd.readouterr()) == ''


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


def test_a_folder_is_read_by_content_and_nothing_in_it_is_skipped(tmp_path: Path) -> None:
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
def test_fits_is_read_compressed_and_by_any_name(
    tmp_path: Path, name: str, pack: Callable[[bytes], bytes]
) -> None:
    stream = io.BytesIO()
    fits.PrimaryHDU(PIXELS[:, :, 0]).writeto(stream)
    for path in (tmp_path / name, tmp_path / 'renamed'):
        path.write_bytes(pack(stream.getvalue()))
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
def test_strange_facts_are_facts_that_are_not_known(case: str, tmp_path: Path) -> None:
    of_exif, gps = STRANGE[case]
    exif = Image.Exif()
    exif.update({**CANON, EXIF: dict(of_exif), GPS: dict(gps)})
    Image.fromarray(PIXELS).save(tmp_path / 'a.jpg', exif=exif)
    photograph = read(tmp_path / 'a.jpg')
    assert 631152000 <= photograph.time_ns / 1e9 < 2**31
    assert np.isnan(photograph.focal_px)
    assert photograph.site is None or max(map(abs, photograph.site[:2])) < 1.02
    assert photograph.camera.startswith('Canon EOS')


def test_a_focal_length_that_no_camera_has_is_an_error_where_it_is_given(tmp_path: Path) -> None:
    (tmp_path / 'a.jpg').write_bytes(encoded('.jpg'))
    with pytest.raises(
        IngestError, match='--focal-length-mm and --pixel-size-um give .* 2e-07 px'
    ):
        look_at(tmp_path / 'a.jpg', focal_length_mm=1e-9, pixel_um=5.0)


def test_a_time_of_a_file_outside_of_the_calendar_is_a_time(tmp_path: Path) -> None:
    (tmp_path / 'a.jpg').write_bytes(encoded('.jpg'))
    for seconds in (-(10**9), 2**33):
        os.utime(tmp_path / 'a.jpg', (seconds, seconds))
        assert 631152000 <= look_at(tmp_path / 'a.jpg').time_ns / 1e9 < 2**31


def test_a_png_with_a_tiny_header_and_much_behind_it(tmp_path: Path) -> None:
    data = bytearray(encoded('.png'))
    data[16:24] = struct.pack('>II', 60000, 60000)
    (tmp_path / 'a.png').write_bytes(data)
    with pytest.raises(IngestError, match=r'a\.png: '):
        read(tmp_path / 'a.png')
