# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Residuals of a calibration by star and image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import aligned_by, calibration_of, estimated
from starcal_ros.processes import one_blas_thread
from starcal_ros.record_fields import Record, Shape, Within
from starcal_ros.records import Calibration, Ensemble


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Record):
    """
    Residuals of a calibration, m images in time order and n stars in image order.

    Attributes
    ----------
    image_time_ns : (m,) int64
    image_misfit : (m,) bool
        Images whose attitude does not fit, or that lost their stars.
    attitude_error_arcsec : (m, 3)
        Error of the star tracker, from the stars of the image and the common alignment: the small
        passive rotation about its own axes from the true to the reported attitude.  NaN if the
        image has too few stars.
    attitude_sigma_arcsec : (m, 3)
        Its 1-sigma from the centroids, for a known camera.
    image : (n,) int64
        Index of the image of the star.
    catalog_id : (n,) int64
    magnitude, colour_bp_rp : (n,) float64
        V and Gaia BP - RP; NaN if not in the catalog.
    measured_px : (n, 2)
    residual_px : (n, 2)
        Measured minus predicted.
    covariance_px2 : (n, 3)
        uu, uv, vv of the centroids, as weighted in the final estimation.
    used : (n,) bool
        False for outliers and stars of images that were left out.
    """

    image_time_ns: Annotated[NDArray[np.int64], Shape(('m',))]
    image_misfit: Annotated[NDArray[np.bool_], Shape(('m',))]
    attitude_error_arcsec: Annotated[Floats, Shape(('m', 3))]
    attitude_sigma_arcsec: Annotated[Floats, Shape(('m', 3))]
    image: Annotated[NDArray[np.int64], Within(0), Shape(('n',))]
    catalog_id: Annotated[NDArray[np.int64], Shape(('n',))]
    magnitude: Annotated[Floats, Shape(('n',))]
    colour_bp_rp: Annotated[Floats, Shape(('n',))]
    measured_px: Annotated[Floats, Shape(('n', 2))]
    residual_px: Annotated[Floats, Shape(('n', 2))]
    covariance_px2: Annotated[Floats, Shape(('n', 3))]
    used: Annotated[NDArray[np.bool_], Shape(('n',))]

    def image_rms_px(self) -> Floats:
        """RMS per axis (m,) over the used stars of each image; NaN if none is used."""
        m = len(self.image_time_ns)
        image = self.image[self.used]
        squares = np.bincount(image, (self.residual_px[self.used] ** 2).mean(axis=1), m)
        count = np.bincount(image, minlength=m)
        mean: Floats = np.divide(squares, count, out=np.full(m, np.nan), where=count > 0)
        return np.asarray(np.sqrt(mean))


def residuals_of(estimate: Estimate, ensemble: Ensemble, colour_bp_rp: Floats) -> Residuals:
    """
    Residuals of an estimate.

    Parameters
    ----------
    ensemble : Ensemble
        Ensemble of the estimate.
    colour_bp_rp : (n,)
        Colours of the stars in the table of the estimate.
    """
    table, attitudes = estimate.table, estimate.attitudes
    seen = attitudes.seen[:, None]
    # The estimate has the opposite sign: from the reported to the true attitude.
    error_arcsec = -attitudes.error_rad / ARCSECOND_RAD
    sigma_rad = np.sqrt(np.einsum('mii->mi', attitudes.covariance_rad2))
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
        covariance_px2=estimate.weights.covariance_px2,
        used=estimate.kept,
    )


@one_blas_thread()
def solve_with_residuals(
    ensemble: Ensemble, setup: Setup, inputs: Mapping[str, str] | None = None
) -> tuple[Calibration, Residuals]:
    """
    The calibration of `solve.solve`, and its residuals by star and image.

    ``inputs`` maps the names of the sources of the observations to their digests, for the
    provenance.
    """
    setup = aligned_by(ensemble, setup)
    found = estimated(ensemble, setup)
    calibration = calibration_of(found, ensemble, setup)
    sources = {f'input {name}': digest for name, digest in (inputs or {}).items()}
    colour_bp_rp = setup.catalog.colours_bp_rp(found.table.catalog_id)
    return (
        replace(calibration, provenance={**calibration.provenance, **sources}),
        residuals_of(found, ensemble, colour_bp_rp),
    )
