"""What a calibration left over, star by star and image by image: ``residuals.npz``, both ways."""

from __future__ import annotations

from dataclasses import dataclass, fields
import io
from pathlib import Path
import zipfile

import numpy as np
from numpy.typing import NDArray

from starcal_ros.calibration import Estimate
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.product_files import write_atomically
from starcal_ros.records import Ensemble

Floats = NDArray[np.float64]

RESIDUALS_FILE = 'residuals.npz'
_FORMAT = 1


@dataclass(frozen=True)
class Residuals:
    """
    Residuals of a calibration, m images in time order and n stars in image order.

    Attributes
    ----------
    image_time_ns : (m,) int64
    image_misfit : (m,) bool
        Images whose attitude does not fit, or that lost their stars.
    attitude_error_arcsec : (m, 3)
        Of the star tracker, by the stars of the image alone and the common alignment: the passive
        small rotation about its own axes that takes the truth to what it reports.  NaN where the
        image has too few stars to tell.
    attitude_sigma_arcsec : (m, 3)
        1-sigma of it from the centroids, the camera taken as known.
    image : (n,) int64
        Which image the star is in.
    catalog_id : (n,) int64
    magnitude, colour_bp_rp : (n,) float64
        V, and Gaia BP - RP; NaN where the catalog has none.
    measured_px : (n, 2)
    residual_px : (n, 2)
        Measured less predicted.
    covariance_px2 : (n, 3)
        uu, uv, vv of the centroids, as the last search has weighted them.
    used : (n,) bool
        False for outliers and stars of images that were left out.
    """

    image_time_ns: NDArray[np.int64]
    image_misfit: NDArray[np.bool_]
    attitude_error_arcsec: Floats
    attitude_sigma_arcsec: Floats
    image: NDArray[np.int64]
    catalog_id: NDArray[np.int64]
    magnitude: Floats
    colour_bp_rp: Floats
    measured_px: Floats
    residual_px: Floats
    covariance_px2: Floats
    used: NDArray[np.bool_]

    def image_rms_px(self) -> Floats:
        """RMS per axis (m,) over the stars used of each image; NaN where none was."""
        m = len(self.image_time_ns)
        image = self.image[self.used]
        squares = np.bincount(image, (self.residual_px[self.used] ** 2).mean(axis=1), m)
        count = np.bincount(image, minlength=m)
        mean: Floats = np.divide(squares, count, out=np.full(m, np.nan), where=count > 0)
        return np.asarray(np.sqrt(mean))


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


def residuals_of(estimate: Estimate, ensemble: Ensemble, colour_bp_rp: Floats) -> Residuals:
    """
    Residuals of an estimate.

    Parameters
    ----------
    ensemble : Ensemble
        That the estimate was made from.
    colour_bp_rp : (n,)
        Of the stars of the estimate's table.
    """
    table = estimate.table
    seen = estimate.attitude_seen[:, None]
    # The estimation counts from what was reported to the truth.
    error_arcsec = -estimate.attitude_error_rad / ARCSECOND_RAD
    sigma_rad = np.sqrt(np.einsum('mii->mi', estimate.attitude_covariance_rad2))
    return Residuals(
        image_time_ns=np.array([image.time_ns for image in ensemble.images], np.int64),
        image_misfit=estimate.misfit_image,
        attitude_error_arcsec=np.where(seen, error_arcsec, np.nan),
        attitude_sigma_arcsec=np.where(seen, sigma_rad / ARCSECOND_RAD, np.nan),
        image=table.image,
        catalog_id=table.catalog_id,
        magnitude=np.concatenate([image.magnitude for image in ensemble.images]).astype(float),
        colour_bp_rp=colour_bp_rp,
        measured_px=table.measured_px,
        residual_px=estimate.residual_px,
        covariance_px2=estimate.variance.of(table.covariance_px2),
        used=estimate.kept,
    )


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
