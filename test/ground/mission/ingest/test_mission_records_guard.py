# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files that would take gigabytes, minutes or the process end their reader, in one line each."""

from collections.abc import Iterator
import gzip
import os
from pathlib import Path
import re

from astropy.io import fits
import numpy as np
import pytest

from starcal_ground.images.image_series import ImageOptions, look
from starcal_ground.mission.ingest.mission_records import Guard
from starcal_ros.errors import IngestError

pytestmark = pytest.mark.slow

TIMED = ImageOptions(times={'a.fits': 1, 'a.fits.gz': 1})


@pytest.fixture
def guard(forked_readers: None) -> Iterator[Guard]:
    with Guard(processor_s=0.5, wall_s=200.0) as made:
        yield made


def write_tiled(path: Path, side: int) -> None:
    """Write a compressed image of zeros whose tiles, one row each, all have the same bytes."""
    small = fits.CompImageHDU(np.zeros((1, side), np.int32), compression_type='RICE_1')
    small.writeto(path)
    with fits.open(path, disable_image_compression=True) as units:
        header, tile = units[1].header.copy(), np.array(units[1].data['COMPRESSED_DATA'][0])
    tiles = np.empty(side, object)
    tiles[:] = [tile] * side
    column = fits.Column('COMPRESSED_DATA', 'PB()', array=tiles)
    table = fits.BinTableHDU.from_columns([column])
    kept = [card for card in header.cards if card.keyword.startswith('Z')]
    table.header.extend([*kept], update=True)
    table.header['ZNAXIS2'] = side
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)


def test_a_tiled_image_of_ordinary_size_is_read(tmp_path) -> None:
    write_tiled(tmp_path / 'a.fits', 600)
    with Guard() as guard:  # astropy is imported in its time
        found = guard.call(tmp_path / 'a.fits', look, tmp_path / 'a.fits', TIMED)
    assert (found.width, found.height, found.high) == (600, 600, 0.0)


START, EMPTY = (unit().header.tostring().encode() for unit in (fits.PrimaryHDU, fits.ImageHDU))
WITHOUT_END = gzip.compress(b'SIMPLE  =                    T'.ljust(80))


@pytest.mark.parametrize(
    ('name', 'write', 'why'),
    [
        # 529 MB of pixels, and twice that on the way.
        ('a.fits', lambda path: write_tiled(path, 11500), 'memory|processor'),
        (
            'a.fits.gz',
            lambda path: path.write_bytes(WITHOUT_END + 100 * gzip.compress(b' ' * 2**24, 1)),
            'takes more than 0.5 s of processor time',
        ),
        (
            'a.fits',
            lambda path: path.write_bytes(START + EMPTY * 20_000),
            'takes more than 0.5 s of processor time',
        ),
    ],
    ids=['small tiled image', 'header without end', 'many empty extensions'],
)
def test_a_file_may_not_take_gigabytes_or_minutes(name, write, why, tmp_path, guard) -> None:
    path = tmp_path / name
    write(path)
    with pytest.raises(IngestError, match=rf'{re.escape(name)}: .*({why})') as error:
        guard.call(path, look, path, TIMED)
    assert '\n' not in str(error.value)


def test_a_reader_may_not_wait_for_a_pipe(tmp_path, forked_readers) -> None:
    os.mkfifo(tmp_path / 'pipe')
    with Guard(wall_s=1.0) as guard, pytest.raises(IngestError, match='than 1 s .* a pipe'):
        guard.call('pipe', os.open, tmp_path / 'pipe', os.O_RDONLY)


def test_a_reader_that_ends_costs_its_call_only(guard) -> None:
    for function, args, why in (
        (bytearray, (2**31,), 'x: needs more than 1 GB of memory'),
        (os.abort, (), 'x: ends its reader with status -6'),
        (int, ('one',), 'x: cannot be read: ValueError invalid literal'),
        (sum, (range(10**11),), 'x: takes more than 0.5 s of processor time'),
    ):
        with pytest.raises(IngestError, match=why):
            guard.call('x', function, *args)
        assert guard.call('x', abs, -3) == 3


def test_what_a_library_prints_is_no_answer_and_the_reader_ends_with_its_guard() -> None:
    with Guard() as guard:
        assert guard.call('x', os.write, 1, b'printed') == 7
        assert guard.call('x', print, 'printed') is None
        number = guard.call('x', os.getpid)
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)
