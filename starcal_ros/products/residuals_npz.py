# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Read and write the residuals of a calibration, ``residuals.npz``."""

from __future__ import annotations

from dataclasses import fields
import io
from pathlib import Path
import zipfile

import numpy as np

from starcal_ros.assessment.residuals import Residuals
from starcal_ros.errors import ProductError
from starcal_ros.products.files import write_atomically

RESIDUALS_FILE = 'residuals.npz'
_FORMAT = 1

_COLUMNS = {
    'image_time_ns': (np.int64, ('m',)),
    'image_misfit': (np.bool_, ('m',)),
    'attitude_error_arcsec': (np.float64, ('m', 3)),
    'attitude_sigma_arcsec': (np.float64, ('m', 3)),
    'image': (np.int64, ('n',)),
    'catalog_id': (np.int64, ('n',)),
    'magnitude': (np.float64, ('n',)),
    'colour_bp_rp': (np.float64, ('n',)),
    'measured_px': (np.float64, ('n', 2)),
    'residual_px': (np.float64, ('n', 2)),
    'covariance_px2': (np.float64, ('n', 3)),
    'used': (np.bool_, ('n',)),
}


def write_residuals(residuals: Residuals, path: Path) -> None:
    """
    Write ``residuals.npz``: a NumPy archive with an array for each attribute of `Residuals`.

    Raises
    ------
    ProductError
        When the file cannot be written.
    """
    memory = io.BytesIO()
    columns = {field.name: getattr(residuals, field.name) for field in fields(residuals)}
    np.savez_compressed(memory, format=_FORMAT, **columns)
    write_atomically(path, memory.getvalue())


def read_residuals(path: Path) -> Residuals:
    """
    The residuals in a ``residuals.npz``, equal to those that were written.

    Raises
    ------
    ProductError
        Naming the file and the array that is missing or wrong.
    """
    columns = {}
    try:
        # Read whole first: numpy leaves a file open that is no archive.
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            if int(archive['format']) != _FORMAT:
                raise ProductError(f'{path}: format {archive["format"]} is not {_FORMAT}')
            for name in _COLUMNS:
                columns[name] = archive[name]
    except OSError as error:
        raise ProductError(f'{path}: cannot be read: {error.strerror or error}') from error
    except KeyError as error:
        raise ProductError(f'{path}: no array {error.args[0]}') from error
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise ProductError(f'{path}: not a NumPy archive: {error}') from error
    size = {'m': len(columns['image_time_ns']), 'n': len(columns['image'])}
    for name, (kind, letters) in _COLUMNS.items():
        shape = tuple(size[one] if isinstance(one, str) else one for one in letters)
        found = columns[name]
        if found.shape != shape or found.dtype != kind:
            raise ProductError(
                f'{path}: {name} is {found.dtype} of shape {found.shape}, '
                f'not {np.dtype(kind)} of {shape}'
            )
    image = columns['image']
    if len(image) and not (image.min() >= 0 and image.max() < size['m']):
        raise ProductError(f'{path}: image names images that are not there')
    return Residuals(**columns)
