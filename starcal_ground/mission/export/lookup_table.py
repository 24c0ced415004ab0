# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tables of the line of sight of each pixel, as CSV, NumPy archive or FITS."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import LineOfSightTable
from starcal_ros.errors import needing, ProductError
from starcal_ros.formats.products.product_files import write_atomically


def write_lookup_table(table: LineOfSightTable, path: Path) -> None:
    """
    Write a table in the format of the file extension: .csv, .npz or .fits.

    Raises ProductError for another extension, a file that cannot be written, or .fits without
    astropy.
    """
    columns: dict[str, Any] = table.columns()  # the stub of savez_compressed wants no others
    if path.suffix == '.csv':
        rows = (
            ','.join(repr(float(value)) for value in row)
            for row in zip(*columns.values(), strict=True)
        )
        write_atomically(path, '\n'.join([','.join(columns), *rows]) + '\n')
    elif path.suffix == '.npz':
        memory = io.BytesIO()
        np.savez_compressed(memory, **columns)
        write_atomically(path, memory.getvalue())
    elif path.suffix == '.fits':
        write_atomically(path, _fits(columns, path))
    else:
        raise ProductError(f'{path}: ends neither in .csv nor in .npz nor in .fits')


def _fits(values: dict[str, Floats], path: Path) -> bytes:
    with needing('mission', ProductError, path):
        from astropy.io import fits
    units = {'px': 'pix', 'arcsec': 'arcsec'}
    columns = [
        fits.Column(name=name, format='D', array=column, unit=units.get(name.rsplit('_', 1)[-1]))
        for name, column in values.items()
    ]
    memory = io.BytesIO()
    fits.BinTableHDU.from_columns(columns, name='LINES_OF_SIGHT').writeto(memory)
    return memory.getvalue()
