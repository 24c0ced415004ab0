# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Image files of every kind that is read, and the ones that are refused in one line."""

import dataclasses
from pathlib import Path

from astropy.io import fits
import cv2
from mission_files import date, images, write_fits  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ground.images.image_series import (
    check_alike,
    common_scale,
    ImageOptions,
    look,
    pixels_of,
)
from starcal_ground.mirror import MIRRORED
from starcal_ros.errors import IngestError

IMAGE = images()[0]
PLAIN = ImageOptions()


def read(path: Path, options: ImageOptions = PLAIN) -> np.ndarray:
    return np.asarray(pixels_of(path, options, common_scale([look(path, options)], options)))


def test_floating_point_is_mapped_to_16_bit_by_a_known_scale_or_range(tmp_path) -> None:
    path = write_fits(tmp_path / 'a.fits', IMAGE, 'float32')
    scale = common_scale([look(path, PLAIN)], PLAIN)
    pixels = read(path)
    values = IMAGE.pixels.astype('f4') * 2.5 - 100.0
    assert pixels.dtype == np.uint16 and 0 < pixels.max() <= 65000
    back = pixels * scale.step + scale.offset
    assert np.abs(back - values).max() <= scale.step * 0.5001  # rounding to whole numbers
    options = ImageOptions(value_range=(0.0, 650.0))
    pixels = read(path, options)
    expected = np.clip(np.rint(values / 0.01), 0, 65535)
    assert np.abs(pixels - expected).max() <= 1  # float32 of 650 resolves 6e-5, 0.01 of a step


def test_negative_numbers_are_shifted_without_loss_and_none_becomes_the_median(tmp_path) -> None:
    header = fits.Header({'DATE-AVG': date(IMAGE.time_ns)})
    path, none = tmp_path / 'a.fits', tmp_path / 'b.fits'
    values = IMAGE.pixels.astype(np.int32) - 1000
    fits.PrimaryHDU(values, header).writeto(path)
    scale = common_scale([look(path, PLAIN)], PLAIN)
    assert (scale.offset, scale.step) == (values.min(), 1.0)
    assert (read(path) + scale.offset == values).all()
    with_nan = IMAGE.pixels.astype('f4')
    with_nan[3, 5] = np.nan
    fits.PrimaryHDU(with_nan, header).writeto(none)
    pixels = read(none)
    assert abs(int(pixels[3, 5]) - int(np.median(pixels))) <= 1


@pytest.mark.parametrize('ending', ['.png', '.tiff'])
def test_pictures_take_their_time_from_a_table(tmp_path, ending) -> None:
    path = tmp_path / f'a{ending}'
    cv2.imwrite(str(path), IMAGE.pixels)
    options = ImageOptions(times={path.name: 17})
    assert look(path, options).time_ns == 17
    assert (read(path, options) == IMAGE.pixels).all()
    with pytest.raises(IngestError, match='has no time: give --times'):
        look(path, PLAIN)
    with pytest.raises(IngestError, match='not in the table of --times'):
        look(path, ImageOptions(times={}))


@pytest.mark.parametrize('flip', MIRRORED)
@pytest.mark.parametrize('kind', ['one colour', 'a colour of three', 'a mosaic'])
def test_a_flip_mirrors_the_pixels_that_are_written(tmp_path, flip, kind) -> None:
    path = tmp_path / 'a.png'
    shape = (12, 10, 3) if kind == 'a colour of three' else (12, 10)
    cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 60000, shape, np.uint16))
    options = ImageOptions(
        {path.name: 1},
        channel='' if kind == 'one colour' else 'green',
        bayer='rggb' if kind == 'a mosaic' else '',
    )
    stated = dataclasses.replace(options, flip=flip)
    plain = read(path, options)
    assert (read(path, stated) == (plain[::-1] if flip == 'top-bottom' else plain[:, ::-1])).all()
    assert look(path, stated).pixels_of == f'{MIRRORED[flip]} (--flip)'


def test_a_colour_of_an_image_is_chosen(tmp_path) -> None:
    rgb = np.random.default_rng(1).integers(0, 60000, (12, 10, 3), np.uint16)
    path, cube = tmp_path / 'a.png', tmp_path / 'a.fits'
    cv2.imwrite(str(path), rgb[:, :, ::-1])  # OpenCV writes BGR
    hdu = fits.PrimaryHDU(
        np.moveaxis(rgb, -1, 0), fits.Header({'DATE-AVG': '2026-05-15T07:20:00'})
    )
    hdu.writeto(cube)
    for number, channel in enumerate(('red', 'green', 'blue')):
        options = ImageOptions(times={'a.png': 1, 'a.fits': 1}, channel=channel)
        for file in (path, cube):
            assert (read(file, options) == rgb[:, :, number]).all()
    with pytest.raises(IngestError, match='choose --channel'):
        look(cube, PLAIN)


@pytest.mark.parametrize(
    ('bayer', 'channel', 'first'), [('rggb', 'green', 1), ('grbg', 'blue', 10)]
)
def test_a_colour_of_a_mosaic_has_half_the_size(tmp_path, bayer, channel, first) -> None:
    path = tmp_path / 'a.png'
    cv2.imwrite(str(path), np.arange(80, dtype=np.uint16).reshape(8, 10))
    pixels = read(path, ImageOptions({'a.png': 1}, channel=channel, bayer=bayer))
    assert pixels.shape == (4, 5) and pixels[0, 0] == first and pixels[1, 1] == first + 22


MIDDLE = '2026-05-15T07:20:00.5'
START = {'DATE-OBS': '2026-05-15T07:20:00'}


@pytest.mark.parametrize(
    ('header', 'why'),
    [
        ({'DATE-AVG': 'yesterday'}, 'yesterday'),
        (
            {'DATE-OBS': '2026-05-15', 'UT': '07:20:00', 'TIME-OBS': '09:20:00', 'EXPTIME': 1},
            'TIME-OBS, UT differ: give --time-key or --times',
        ),
        ({'DATE-OBS': '2026-05-15', 'UT': 26400.0, 'EXPTIME': 1.0}, 'T26400.0. is not a date'),
        ({**START, 'EXPTIME': 0.0}, 'EXPTIME = 0.0 is not the duration'),
        ({**START, 'EXPTIME': 'long'}, 'EXPTIME = long is not the duration'),
        # Free text may say anything: only brackets are a unit (FITS standard 4.0, 4.3.2).
        ({**START, 'EXPTIME': (250, 'exposure in ms')}, "EXPTIME is in 'exposure in ms'"),
        ({**START, 'EXPTIME': (250, '[adu]')}, "EXPTIME is in 'adu', expected a unit as"),
        ({'DATE-BEG': MIDDLE, 'DATE-END': '2026-05-15T07:20:00'}, 'DATE-END is before DATE-BEG'),
    ],
)
def test_a_time_that_would_be_a_guess_is_one_line(tmp_path, header, why) -> None:
    path = write_fits(tmp_path / 'a.fits', IMAGE, **header)
    with pytest.raises(IngestError, match=why) as error:
        look(path, PLAIN)
    assert str(path) in str(error.value) and '\n' not in str(error.value)


@pytest.mark.parametrize('kind', ['uint16', 'tiled'])
def test_a_card_that_nothing_needs_may_be_damaged(tmp_path, kind) -> None:
    header = {'DATE-OBS': MIDDLE, 'EXPTIME': 1.0, 'OBSERVER': 'x', 'SITELAT': 1.0}
    path = write_fits(tmp_path / 'a.fits', IMAGE, kind, **header)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"'x       '", b'  M. Night'))
    assert (read(path) == IMAGE.pixels).all()
    path.write_bytes(content.replace(b"'2026-05-15T07:20:00.5'", b' 2026-05-15T07:20:00:5 '))
    with pytest.raises(IngestError, match='is not a date and time') as error:
        look(path, PLAIN)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('shape', [(10, 48, 64), (48, 64, 4), (2, 48, 64)])
def test_a_cube_is_no_colour_image(tmp_path, shape) -> None:
    path = tmp_path / 'a.fits'
    fits.PrimaryHDU(np.zeros(shape, np.int16), fits.Header({'DATE-AVG': MIDDLE})).writeto(path)
    for channel in ('', 'red'):
        with pytest.raises(
            IngestError, match=r'shape .*, neither an image nor three colour planes'
        ):
            look(path, ImageOptions(channel=channel))


def test_keys_of_time_as_the_middle_and_of_temperature_are_stated(tmp_path) -> None:
    header = {'DATE-OBS': MIDDLE, 'EXPTIME': 9.0, 'CCD-TEMP': -21.5, 'SATURATE': 60000}
    path = write_fits(tmp_path / 'a.fits', IMAGE, **header)
    found = look(path, ImageOptions(time_key='DATE-OBS', temperature_key='CCD-TEMP'))
    assert found.time_ns % 10**9 == 500_000_000
    assert (found.temperature_degc, found.saturation) == (-21.5, 60000.0)
    with pytest.raises(IngestError, match='no keyword T0'):
        look(path, ImageOptions(time_key='T0'))


def test_a_tiled_image_that_claims_gigabytes_is_not_decoded(tmp_path) -> None:
    """Pictures that do are refused in test/onboard/formats/messages/test_sensor_messages.py."""
    tiled = fits.CompImageHDU(np.zeros((9, 9), np.uint8))
    tiled.writeto(tmp_path / 'a.fits')
    content = bytearray((tmp_path / 'a.fits').read_bytes())
    for card in (b'ZNAXIS1 =                    9', b'ZNAXIS2 =                    9'):
        at = content.index(card)
        content[at : at + len(card)] = card[:-5] + b'60000'
    (tmp_path / 'a.fits').write_bytes(content)
    with pytest.raises(IngestError, match=r'a\.fits: no image of up to'):
        look(tmp_path / 'a.fits', PLAIN)


def test_images_of_two_sizes_or_one_time_are_refused(tmp_path) -> None:
    a = look(write_fits(tmp_path / 'a.fits', IMAGE), PLAIN)
    b = look(write_fits(tmp_path / 'b.fits', IMAGE), PLAIN)
    with pytest.raises(IngestError, match=r'b\.fits: has the time of .*a\.fits'):
        check_alike([a, b])
    cut = type(IMAGE)(IMAGE.time_ns + 1, IMAGE.pixels[:-2])
    c = look(write_fits(tmp_path / 'c.fits', cut), PLAIN)
    with pytest.raises(IngestError, match=r'c\.fits: 640 x 510 pixels, .*a\.fits has 640 x 512'):
        check_alike([a, c])
