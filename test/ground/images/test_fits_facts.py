# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""FITS headers of cameras and programs, card by card: a library would correct what is given."""

import calendar
from collections.abc import Callable, Mapping, Sequence
import dataclasses
import gzip
import math
import os
from pathlib import Path

from astropy.io import fits
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.images.from_stars import FromStars, ideal_camera
from starcal_ground.images.image_series import common_scale, ImageOptions, look, pixels_of
from starcal_ground.images.night_sky import photographs_of
from starcal_ground.images.photographs import look_at, Photograph, pixels_of_photograph
from starcal_ground.images.stated import focal_lengths_of, half_turns, site_of, too_few_stars
from starcal_ros.errors import IngestError
from starcal_ros.sky.astrometry import air_above, SiteOptions
from starcal_ros.sky.catalog import load_catalog

HEIGHT, WIDTH = 30, 40
PIXELS = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH)
MIDDLE_NS = calendar.timegm((2024, 3, 9, 22, 10, 4)) * 10**9
FILE_NS = calendar.timegm((2020, 1, 1, 0, 0, 0)) * 10**9
START, EIGHT = "DATE-OBS= '2024-03-09T22:10:00'", 'EXPTIME =                  8.0'
MJD = 60378 + (22 * 3600 + 10 * 60) / 86400
# A Julian date in a double resolves 40 us, a modified one 0.6 us.
JULIAN_NS = 50_000


def unit(pixels: np.ndarray, cards: Sequence[str], extension: bool = False) -> bytes:
    """Header and data of a FITS unit (sections 3.3 and 4 of the standard), 16 bit unsigned."""
    first = "XTENSION= 'IMAGE   '" if extension else 'SIMPLE  =                    T'
    sides = [f'NAXIS{k + 1:<3}= {side:20}' for k, side in enumerate(pixels.shape[::-1])]
    needed = [first, f'BITPIX  = {16:20}', f'NAXIS   = {len(sides):20}', *sides]
    needed += [f'PCOUNT  = {0:20}', f'GCOUNT  = {1:20}'] * extension
    needed += [f'BZERO   = {32768:20}', f'BSCALE  = {1:20}']
    header = ''.join(card.ljust(80) for card in [*needed, *cards, 'END'])
    data = (pixels.astype(np.int32) - 32768).astype('>i2').tobytes()
    blocks = [header.encode().ljust(-(-len(header) // 2880) * 2880), data]
    blocks[1] += bytes(-len(data) % 2880)
    return b''.join(blocks)


def file_of(folder: Path, *cards: str, pixels: np.ndarray = PIXELS) -> Path:
    path = folder / 'a.fits'
    path.write_bytes(unit(pixels, cards))
    os.utime(path, ns=(FILE_NS, FILE_NS))
    return path


TIMES: Mapping[str, tuple[str, ...]] = {
    'start and exposure': (START, EIGHT),
    'zone': ("DATE-OBS= '2024-03-09T15:10:00.000-0700'", EIGHT),
    'zone with a colon': ("DATE-OBS= '2024-03-10T03:40:00+05:30'", EIGHT),
    'Z': ("DATE-OBS= '2024-03-09T22:10:00Z'", EIGHT),
    'UT behind it': ("DATE-OBS= '2024-03-09 22:10:00 UT'", EIGHT),
    'zone, with UT and MJD': (
        "DATE-OBS= '2024-03-09T15:10:00.000-0700'", "DATE-END= '2024-03-09T15:10:10.000-0700'",
        "UT-OBS  = '2024-03-09T22:10:00.000-0000'", 'MJD-OBS =            60378.924', EIGHT,
    ),
    'UT-OBS alone': ("UT-OBS  = '2024-03-09T22:10:00.0'", EIGHT),
    'date and UT-OBS': ("DATE-OBS= '2024-03-09'", "UT-OBS  = '22:10:00'", EIGHT),
    'date and TIME-OBS': ("DATE-OBS= '2024-03-09'", "TIME-OBS= '22:10:00.0'", EIGHT),
    'date with slashes': ("DATE-OBS= '2024/03/09'", "UT      = '22:10:00'", EIGHT),
    'DATE-BEG': ("DATE-BEG= '2024-03-09T22:10:00'", EIGHT),
    'DATE-BEG and DATE-END': (
        "DATE-BEG= '2024-03-09T22:10:00'", "DATE-END= '2024-03-09T22:10:08'"),
    'DATE-OBS and DATE-END': (START, "DATE-END= '2024-03-09T22:10:08'"),
    'MJD-OBS': (f'MJD-OBS = {MJD!r}', EIGHT),
    'MJD-OBS beside a date alone': ("DATE-OBS= '2024-03-09'", f'MJD-OBS = {MJD!r}', EIGHT),
    'long exposure': (
        "DATE-AVG= '2024-03-09T22:10:04'", "DATE-OBS= '2024-03-09T21:10:04'", 'EXPTIME = 7200.0'),
    'MJD-OBS as text': (f"MJD-OBS = '{MJD!r}'", EIGHT),
    'MJD-AVG': (f'MJD-AVG = {MJD + 4 / 86400!r}',),
    'JD': (f'JD      = {MJD + 2400000.5!r}', EIGHT),
    'TT': ("DATE-OBS= '2024-03-09T22:11:09.184'", "TIMESYS = 'TT'", EIGHT),
    'TAI': ("DATE-OBS= '2024-03-09T22:10:37'", "TIMESYS = 'TAI'", EIGHT),
    'GPS': ("DATE-AVG= '2024-03-09T22:10:22'", "TIMESYS = 'GPS'"),
    'clocks that agree': (
        "DATE-OBS= '2024-03-09'", "UTSTART = '22:10:00'", "UT      = '22:10:00.0'", EIGHT),
    'UT is not TAI': ("DATE-OBS= '2024-03-09'", "UT      = '22:10:00'", "TIMESYS = 'TAI'", EIGHT),
    'clocks of both ends': (
        "DATE-BEG= '2024-03-09'", "TIME-BEG= '22:10'", "DATE-END= '2024-03-09'",
        "TIME-END= '22:10:08'"),
    'ms': (START, 'EXPOSURE=               8000.0 / [ms] of the shutter'),
    'min': ("DATE-OBS= '2024-03-09T22:09:04'", 'EXPTIME =                    2 / [min]'),
    'seconds in words': (START, 'EXPTIME = 8.0 / Exposure time in seconds'),
    'TIMEUNIT': ("DATE-BEG= '2024-03-09T22:09:04'", 'XPOSURE = 2', "TIMEUNIT= 'min'"),
    'EXP_TIME': (START, 'EXP_TIME=                  8.0'),
    'exposure as text': (START, "EXPTIME = '8.0     '"),
    'D exponent': (START, 'EXPTIME =                0.8D1'),
    'lower case': ("date-obs= '2024-03-09T22:10:00'", 'exptime =                  8.0'),
    'HIERARCH': (START, 'HIERARCH EXPTIME = 8.0'),
}  # fmt: skip


@pytest.mark.parametrize('name', TIMES)
def test_both_commands_read_the_middle_of_the_exposure(name, tmp_path) -> None:
    path = file_of(tmp_path, *TIMES[name])
    alone, imported = look_at(path), look(path, ImageOptions())
    assert (alone.dated, alone.utc) == (True, True)
    assert alone.time_ns == imported.time_ns
    assert abs(alone.time_ns - MIDDLE_NS) <= (JULIAN_NS if name.startswith(('MJD', 'JD')) else 0)


DOUBTED: Mapping[str, tuple[tuple[str, ...], bool, str]] = {
    'local by MJD': (
        (START, 'MJD-OBS =            60379.2153', EIGHT), True,
        r'DATE-OBS and MJD-OBS differ by 7\.00 h',
    ),
    'local by UT-OBS': (
        (START, "UT-OBS  = '2024-03-10T05:10:00'", EIGHT), True,
        r'DATE-OBS and UT-OBS differ by 7\.00 h',
    ),
    'local by name': ((START, "TIMESYS = 'LOCAL'", EIGHT), True, "'LOCAL' is not one of UTC"),
    'UT1': ((START, "TIMESYS = 'UT1'", EIGHT), True, "'UT1' is not one of UTC"),
    'no exposure time': ((START,), True, 'no exposure time is given'),
    'date alone': (("DATE-OBS= '2024-03-09'", EIGHT), False, 'no time of day'),
    'none': ((EIGHT,), False, 'no time'),
    'empty': (("DATE-OBS= '        '", EIGHT), False, 'no time'),
    'never set': (("DATE-OBS= '1970-01-01T00:00:00'", EIGHT), False, ''),
}  # fmt: skip


@pytest.mark.parametrize('name', DOUBTED)
def test_a_time_in_doubt_is_named_and_used_as_far_as_it_goes(name, tmp_path) -> None:
    cards, dated, doubt = DOUBTED[name]
    path = file_of(tmp_path, *cards)
    alone = look_at(path)
    assert alone.dated == dated and (dated or alone.time_ns == FILE_NS)
    assert alone.utc == (name == 'no exposure time')
    if doubt:
        with pytest.raises(IngestError, match=doubt):
            look(path, ImageOptions())


SCALES: Mapping[str, tuple[tuple[str, ...], tuple[float, ...]]] = {
    'PIXSCALE': (('PIXSCALE=                 20.0 / [arcsec/pixel]',), (10313.24,)),
    'SECPIX': (('SECPIX  =                 20.0',), (10313.24,)),
    'IM_SCALE': (('IM_SCALE= 20.0 / Image scale in arc-secs/pixel',), (10313.24,)),
    'in degrees': (('PIXSCALE=                 2E-2 / [deg] of a pixel',), (2864.79,)),
    'FOCALLEN, XPIXSZ': (('FOCALLEN=                 50.0', 'XPIXSZ  = 4.0'), (12500.0,)),
    'in metres': (('FOCALLEN= 0.05 / [m]', 'CCDXPIXE=            0.0000040 / [m]'), (12500.0,)),
    'HIERARCH FOCALLENGTH': (('HIERARCH FOCALLENGTH = 50.0', 'XPIXSZ  = 4.0'), (12500.0,)),
    # XPIXSZ is that of the binned pixel or of the detector's, by program.
    'binned': (
        ('FOCALLEN= 50.0', 'XPIXSZ  = 4.0', 'XBINNING= 2'), (12500.0, 6250.0, 25000.0)),
    'CCDSUM': (
        ('FOCALLEN= 50.0', 'PIXSIZE1= 4.0', "CCDSUM  = '2 2     '"), (12500.0, 6250.0, 25000.0)),
    'statements that agree are one': (
        ('PIXSCALE= 16.5', 'FOCALLEN= 50.0', 'XPIXSZ  = 4.0'), (12500.97,)),
    'statements that differ are both tried': (
        ('PIXSCALE= 33.0', 'FOCALLEN= 50.0', 'XPIXSZ  = 4.0'), (6250.45, 12500.0)),
    'CD': (('CD1_1   = -0.006', 'CD2_1   = 0.008'), (5729.58,)),
    'CDELT': (("CTYPE1  = 'RA---TAN'", 'CDELT1  = -0.01', 'CDELT2  = 0.01'), (5729.58,)),
    'CDELT and PC': (
        ('CDELT1  = -0.01', 'CDELT2  = 0.01', 'PC1_1   = 0.6', 'PC2_1   = 0.8'), (5729.58,)),
    'CDELT with D': (('CDELT1  = -1.0D-2', 'CDELT2  = 1.0D-2'), (5729.58,)),
    'no coordinates of the sky': (("CTYPE1  = 'LINEAR'", 'CDELT1  = 1.0'), ()),
    'no camera has it': (('FOCALLEN= 1e9', 'XPIXSZ  = 4.0'), ()),
    'none': (('FOCALLEN= 0.0', 'XPIXSZ  = 0.0'), ()),
}  # fmt: skip


@pytest.mark.parametrize('name', SCALES)
def test_the_instrument_and_the_focal_lengths_that_a_header_states(name, tmp_path) -> None:
    cards, expected_px = SCALES[name]
    one = look_at(file_of(tmp_path, START, EIGHT, *cards, "INSTRUME= 'ASI'"))
    assert one.camera == 'ASI'
    for found in (one.focal_lengths, focal_lengths_of([one, one])):
        assert [f.focal_px for f in found] == pytest.approx(list(expected_px), rel=1e-4)


SITES: Mapping[str, tuple[tuple[str, ...], tuple[float, float, float] | None]] = {
    'SITELAT': (('SITELAT = 31.68', 'SITELONG= -110.88', 'SITEELEV= 1270.0'),
                (31.68, -110.88, 1270.0)),
    'LATITUDE': (('LATITUDE= 31.68 / Local latitude', 'LONGITUD= 249.12'), (31.68, -110.88, 0.0)),
    'sexagesimal': (("LAT-OBS = '-31 40 48'", "LONG-OBS= '110:52:48.0 W'"),
                    (-31.68, -110.88, 0.0)),
    'west by the comment': (('LATITUDE= 31.68', 'LONGITUD= 110.88 / [deg West]'),
                            (31.68, -110.88, 0.0)),
    'OBSGEO-B': (('OBSGEO-B= 31.68', 'OBSGEO-L= -110.88', 'OBSGEO-H= 1270.0', 'LONGITUD= 110.88'),
                 (31.68, -110.88, 1270.0)),
    # Of Haleakala, as its observatory writes it beside latitude, longitude and height.
    'OBSGEO-X': (('OBSGEO-X= -5466057.469', 'OBSGEO-Y= -2404265.073', 'OBSGEO-Z= 2242151.193'),
                 (20.7069694, -156.2575333, 3037.0)),
    'not set': (('SITELAT = 0.0', 'SITELONG= 0.0'), None),
    'half': (('SITELAT = 31.68',), None),
    'no latitude': (('SITELAT = 131.68', 'SITELONG= 1.0'), None),
}  # fmt: skip


@pytest.mark.parametrize('name', SITES)
def test_the_site_that_a_header_states(name, tmp_path) -> None:
    cards, expected = SITES[name]
    site = look_at(file_of(tmp_path, START, EIGHT, *cards)).site
    # 4 m at the ground: cards of the observatory agree to 3 m.
    assert site == (expected and pytest.approx(expected, abs=4e-5 if site and site[2] < 1 else 4))
    if site and expected:
        assert site[:2] == pytest.approx(expected[:2], abs=4e-5)


REGIONS: Mapping[str, tuple[tuple[str, ...], np.ndarray, str]] = {
    'TRIMSEC': (("TRIMSEC = '[5:40,1:30]'",), PIXELS[:, 4:], 'columns 5 to 40, rows 1 to 30'),
    'TRIMSEC before DATASEC': (
        ("DATASEC = '[3:40,1:30]'", "TRIMSEC = '[5:38,2:29]'"), PIXELS[1:29, 4:38], 'TRIMSEC'),
    'DATASEC': (("DATASEC = '[ 5 : 40 , 1 : 30 ]'",), PIXELS[:, 4:], 'DATASEC'),
    'BIASSEC': (("BIASSEC = '[37:40,1:30]'",), PIXELS[:, :36], 'BIASSEC'),
    'BIASSEC below': (("BIASSEC = '[1:40,1:4]'",), PIXELS[4:], 'BIASSEC'),
    'already cut': (("TRIMSEC = '[11:50,4:33]'", "BIASSEC = '[51:60,1:40]'"), PIXELS, ''),
    'whole': (("DATASEC = '[1:40,1:30]'",), PIXELS, ''),
    'not known': (("CCDSEC  = 'UNKNOWN'", "DATASEC = 'UNKNOWN'"), PIXELS, 'is not in the image'),
    'outside': (("TRIMSEC = '[50:80,1:30]'",), PIXELS, 'is not in the image'),
    'BOTTOM-UP': (("ROWORDER= 'BOTTOM-UP'",), PIXELS[::-1], 'rows last to first'),
    'TOP-DOWN': (("ROWORDER= 'TOP-DOWN'",), PIXELS, ''),
    'BOTTOM-UP and TRIMSEC': (
        ("ROWORDER= 'BOTTOM-UP'", "TRIMSEC = '[5:40,3:30]'"), PIXELS[:1:-1, 4:], 'columns 5 to'),
}  # fmt: skip


@pytest.mark.parametrize('name', REGIONS)
def test_the_pixels_of_the_camera_are_read_and_stated(name, tmp_path) -> None:
    cards, expected, words = REGIONS[name]
    path = file_of(tmp_path, START, EIGHT, *cards)
    alone, imported = look_at(path), look(path, ImageOptions())
    assert (alone.width, alone.height) == (imported.width, imported.height)
    assert alone.pixels_of == imported.pixels_of
    assert words in alone.pixels_of and bool(words) == bool(alone.pixels_of)
    scale = common_scale([imported], ImageOptions())
    assert (pixels_of_photograph(path) == expected).all()
    assert (pixels_of(path, ImageOptions(), scale) == expected).all()


# Levels of red, green and blue at each of the sites of a pattern.
LEVELS = {'R': 100, 'G': 200, 'B': 300}


def mosaic(pattern: str) -> np.ndarray:
    levels = np.array([LEVELS[letter] for letter in pattern], np.uint16).reshape(2, 2)
    return np.tile(levels, (HEIGHT // 2, WIDTH // 2))


MOSAICS: Mapping[str, tuple[tuple[str, ...], np.ndarray]] = {
    **{
        pattern: ((f"BAYERPAT= '{pattern}'",), mosaic(pattern))
        for pattern in ('RGGB', 'BGGR', 'GBRG', 'GRBG')
    },
    'COLORTYP': (("COLORTYP= 'RGGB    '",), mosaic('RGGB')),
    'lower case': (("bayerpat= 'rggb'",), mosaic('RGGB')),
    'XBAYROFF': (("BAYERPAT= 'RGGB'", 'XBAYROFF= 1'), mosaic('GRBG')),
    'both offsets': (("BAYERPAT= 'RGGB'", 'XBAYROFF= 1', 'YBAYROFF= 1'), mosaic('BGGR')),
    'BOTTOM-UP': (("BAYERPAT= 'RGGB'", "ROWORDER= 'BOTTOM-UP'"), mosaic('GBRG')),
    'rows in another order than it says': (("BAYERPAT= 'RGGB'",), mosaic('GBRG')),
    'cut': (("BAYERPAT= 'RGGB'", "TRIMSEC = '[2:39,1:30]'"), mosaic('RGGB')),
}  # fmt: skip


@pytest.mark.parametrize('name', MOSAICS)
def test_a_colour_of_a_mosaic_is_taken_by_its_header(name, tmp_path) -> None:
    cards, pixels = MOSAICS[name]
    path = file_of(tmp_path, START, EIGHT, *cards, pixels=pixels)
    for channel, letter in (('', 'G'), ('red', 'R'), ('green', 'G'), ('blue', 'B')):
        assert (pixels_of_photograph(path, channel) == LEVELS[letter]).all()
        if channel:
            options = ImageOptions(channel=channel)
            read = pixels_of(path, options, common_scale([look(path, options)], options))
            assert (read == LEVELS[letter]).all() and read.shape[0] == HEIGHT // 2
    with pytest.raises(IngestError, match='a mosaic, .* choose --channel'):
        look(path, ImageOptions())


def test_green_of_a_mosaic_is_linear_between_its_sites(tmp_path) -> None:
    path = file_of(tmp_path, "BAYERPAT= 'RGGB'", pixels=PIXELS)
    green = pixels_of_photograph(path)
    # A plane is its own linear interpolation, but for the border, where it is mirrored.
    assert (green[1:-1, 1:-1] == PIXELS[1:-1, 1:-1]).all()
    with pytest.raises(IngestError, match='COLORTYP CMYG: of mosaics RGGB'):
        look_at(file_of(tmp_path, "COLORTYP= 'CMYG'"))
    for none in ('MONO', 'NONE', '', 'RGB'):
        assert (pixels_of_photograph(file_of(tmp_path, f"BAYERPAT= '{none}'")) == PIXELS).all()


def units_of(*units: tuple[str, np.ndarray]) -> bytes:
    """A file of a unit for each name; the first is the primary one."""
    parts = [
        unit(pixels, [f"EXTNAME = '{name}'", START, EIGHT], extension=k > 0)
        for k, (name, pixels) in enumerate(units)
    ]
    return b''.join(parts)


THUMBNAIL, MASK = PIXELS[::3, ::3], np.zeros_like(PIXELS)
FILES: Mapping[str, tuple[bytes, str]] = {
    'thumbnail first': (units_of(('PREVIEW', THUMBNAIL), ('SCI', PIXELS)), ''),
    'thumbnail last': (units_of(('SCI', PIXELS), ('PREVIEW', THUMBNAIL)), ''),
    'mask first': (units_of(('', THUMBNAIL), ('BPM', MASK), ('SCI', PIXELS)), ''),
    'errors and flags': (units_of(('SCI', PIXELS), ('ERR', MASK), ('DQ', MASK)), ''),
    'several detectors': (
        units_of(('', THUMBNAIL), ('CCD1', PIXELS), ('CCD2', MASK)), 'HDU 1 of 2 images'),
    'cube of one': (unit(PIXELS[None], [START, EIGHT]), ''),
    'gzip': (gzip.compress(unit(PIXELS, [START, EIGHT])), ''),
}  # fmt: skip


@pytest.mark.parametrize('name', FILES)
def test_the_image_of_the_sky_is_read(name, tmp_path) -> None:
    content, words = FILES[name]
    path = tmp_path / 'a.fits'
    path.write_bytes(content)
    assert words in look_at(path).pixels_of
    assert bool(words) == bool(look(path, ImageOptions()).pixels_of)
    assert (pixels_of_photograph(path) == PIXELS).all()


def test_files_of_fpack_and_scaled_numbers_are_read(tmp_path) -> None:
    packed, scaled = tmp_path / 'a.fits.fz', tmp_path / 'b.fits'
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(PIXELS)]).writeto(packed)
    values = fits.PrimaryHDU(PIXELS.astype(np.float32))
    values.scale('int16', bzero=100, bscale=0.5)
    values.writeto(scaled)
    assert (pixels_of_photograph(packed) == PIXELS).all()
    # The range of all values is mapped to 65000 steps.
    light = pixels_of_photograph(scaled).astype(float)
    assert light / 65000 == pytest.approx(PIXELS / PIXELS.max(), abs=1e-4)


def test_deep_files_with_a_date_go_before_more_previews(tmp_path) -> None:
    for k in range(10):
        date = f"DATE-OBS= '2024-03-09T22:{k:02}:00'"
        (tmp_path / f'{k}.fits').write_bytes(unit(PIXELS, [date, EIGHT]))
        for part in 'ab':
            cv2.imwrite(str(tmp_path / f'{k}{part}.png'), (PIXELS[::2, ::2] // 8).astype(np.uint8))
    chosen, notes = photographs_of([tmp_path])
    assert [one.path.name for one in chosen] == [f'{k}.fits' for k in range(10)]
    assert notes == ['10 images of 40 x 30 are used; left out: 20 of 20 x 15, which show no stars']


def test_the_deepest_file_of_one_exposure_comes_first(tmp_path) -> None:
    (tmp_path / 'deep.fits.gz').write_bytes(gzip.compress(unit(PIXELS, [START, EIGHT])))
    header = fits.Header({'EXPTIME': 8.0, 'DATE-OBS': '2024-03-09T22:10:00'})
    fits.PrimaryHDU(PIXELS.astype(np.uint8), header).writeto(tmp_path / 'preview.fits')
    chosen, _ = photographs_of([tmp_path])
    assert [one.path.name for one in chosen] == ['deep.fits.gz', 'preview.fits']


def stars_at(rotations: Sequence[Rotation]) -> FromStars:
    """Images whose orientations ``icrf_from_camera`` are given, one a minute."""
    by_stamp = {MIDDLE_NS + k * 60 * 10**9: one for k, one in enumerate(rotations)}
    return FromStars(ideal_camera((640, 512), 1800.0), False, by_stamp, len(by_stamp))


def pointed(ra_deg: float, dec_deg: float, angle_deg: float) -> Rotation:
    """``icrf_from_camera`` of a direction and a position angle."""
    return Rotation.from_euler('ZYZ', [ra_deg, 90 - dec_deg, angle_deg], degrees=True)


def on_a_mount(k: int) -> Rotation:
    return pointed(20.0 * k, 40.0, 30.0 + 0.5 * k)


TURNS: Mapping[str, tuple[Callable[[int], Rotation], str]] = {
    'mount': (on_a_mount, ''),
    'meridian flip': (
        lambda k: on_a_mount(k) * Rotation.from_euler('z', math.pi * (k > 6)),
        '3 of 10 images are turned by 180 degrees',
    ),
    'about the angle where signs change': (
        lambda k: pointed(5.0 * k, -30.0, 90.0 + (-1) ** k + 180.0 * (k < 4)), '4 of 10 images'),
    'tripod': (lambda k: pointed(20.0 * k, 40.0, 36.0 * k), ''),
    'at the pole': (lambda k: pointed(36.0 * k, 89.9, 30.0), ''),
}  # fmt: skip


@pytest.mark.parametrize('name', TURNS)
def test_half_a_turn_between_images_is_named(name) -> None:
    rotation_of, words = TURNS[name]
    note = half_turns(stars_at([rotation_of(k) for k in range(10)]))
    assert note.startswith(words) and bool(words) == bool(note)


@pytest.mark.parametrize(
    ('longitude_deg', 'clock_h', 'words'),
    [
        (-110.88, 0.0, ''),
        (
            110.88,
            0.0,
            'or longitudes count west: --set observer=ground --set latitude_deg=31.68 --set',
        ),
        (-110.88, 12.0, 'the clock is not UTC'),
    ],
)
def test_a_site_whose_horizon_hides_the_stars_is_not_used(longitude_deg, clock_h, words) -> None:
    true = SiteOptions('ground', 31.68, -110.88, 1270.0)
    zeniths = [air_above(MIDDLE_NS + k * 60 * 10**9, true)[0] for k in range(8)]
    angles = [(math.degrees(math.atan2(y, x)), math.degrees(math.asin(z))) for x, y, z in zeniths]
    # The last ones are in the east, as seen from the wrong site too.
    angles[3:] = [(ra_deg + 75.0, dec_deg) for ra_deg, dec_deg in angles[3:]]
    stars = stars_at([pointed(ra_deg, dec_deg, 0.0) for ra_deg, dec_deg in angles])
    moved_ns = round(clock_h * 3600e9)
    rotations = {time_ns + moved_ns: one for time_ns, one in stars.icrf_from_camera.items()}
    stars = dataclasses.replace(stars, icrf_from_camera=rotations)
    files = [
        Photograph(Path('a'), time_ns, True, True, 640, 512, site=(31.68, longitude_deg, 1270.0))
        for time_ns in rotations
    ]
    site, note = site_of(files, stars)
    assert site['observer'] == 'ground' and ('latitude_deg' in site) == (not words)
    assert words in note and bool(words) == bool(note)


PLACE = ((31.31, 46.77),)
DEPTHS: Mapping[str, tuple[tuple[float, ...], Sequence[tuple[float, float]], bool]] = {
    'half a degree': ((0.5,), (), False),
    'half a degree at a place': ((0.5,), PLACE, False),
    'half a degree, or one of other pixels': ((0.5, 1.0), (), False),
    'nine tenths at a place': ((0.9,), PLACE, False),
    'two degrees': ((2.0,), (), True),
    'two degrees at a place': ((2.0,), PLACE, True),
    'sixty degrees': ((60.0,), PLACE, True),
    'half a degree or five': ((0.5, 5.0), (), True),
    'half a degree of the Pleiades': ((0.5,), ((56.75, 24.12),), False),
}


@pytest.mark.parametrize('name', DEPTHS)
def test_a_field_without_stars_of_the_catalog_is_known_by_its_header(name) -> None:
    fields_deg, places, is_enough = DEPTHS[name]
    hints = {
        f'PIXSCALE{k}': ideal_camera((640, 512), 320.0 / math.tan(math.radians(deg / 2)))
        for k, deg in enumerate(fields_deg)
    }
    words = too_few_stars(hints, load_catalog(), False, places)
    assert bool(words) != is_enough
    first = too_few_stars(dict([*hints.items()][:1]), load_catalog(), False, places)
    assert is_enough or words == first  # the field named has the stars named
    assert is_enough or (words.startswith('a field of ') and '(PIXSCALE0)' in words)
    assert is_enough or 'make a deeper one (starcal catalog)' in words
