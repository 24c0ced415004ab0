# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Observability of an ensemble: information, predicted sigmas, coverage, line-of-sight maps."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import (
    common_rotation,
    grid_derivatives,
    line_of_sight_table,
    sigma_arcsec,
)
from starcal_ros.camera import CameraModel, parameter_names, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.equations import information_of_images, stars_alone, StarSums
from starcal_ros.estimation.levenberg_marquardt import inverse, NotObservable
from starcal_ros.estimation.limits import FEWEST
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.estimation.problem import Problem, State, supported_terms
from starcal_ros.estimation.search import estimated, problem_of, start_of
from starcal_ros.estimation.star_equations import arrange, star_table
from starcal_ros.estimation.tracker_errors import correlations_of, expected_slow_of_mean
from starcal_ros.estimation.unknowns import Layout, unknowns_in_state
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    Ensemble,
    EnsembleStatus,
    MapCovariance,
    StarObservations,
)

COVERAGE_ROWS, COVERAGE_COLS = 8, 10  # cells of 2 degrees on the paper's camera
MAP_ROWS, MAP_COLS = 16, 20  # enough for a polynomial surface of degree seven


def coverage(ensemble: Ensemble, camera: CameraModel) -> NDArray[np.int64]:
    """Count of star observations in each focal-plane cell, (8, 10)."""
    return stars_in_cells(star_table(ensemble.images).measured_px, camera)


def stars_in_cells(pixels: Floats, camera: CameraModel) -> NDArray[np.int64]:
    """Count of pixels (n, 2) in each focal-plane cell, (8, 10)."""
    counts, _, _ = np.histogram2d(
        pixels[:, 1],
        pixels[:, 0],
        bins=(COVERAGE_ROWS, COVERAGE_COLS),
        range=((-0.5, camera.height - 0.5), (-0.5, camera.width - 0.5)),
    )
    return counts.astype(np.int64)


def image_information(
    images: tuple[StarObservations, ...], prior: CameraGeometry, options: CalibrationOptions
) -> Floats:
    """
    Information (m, k, k) of each image on the k unknowns that all images share, at the prior.

    These are the estimated camera parameters, the temperature terms if these images support them,
    and the alignment if the method has one; the rotation of the image is eliminated.  An image
    with fewer than three stars in front of the camera has zero information.
    """
    ensemble = Ensemble(images)
    order, with_rate, _ = supported_terms(
        ensemble, options.focal_temperature_order, options.alignment_temperature
    )
    problem, state, layout, sums, _ = _at_the_prior(ensemble, prior, options, order, with_rate)
    kept = estimated(layout)
    information = information_of_images(sums, problem, state, layout)
    seen = np.asarray(sums.blocks.any(axis=(1, 2)))
    return information[:, kept][:, :, kept] * seen[:, None, None]


def estimated_names(options: CalibrationOptions, model: str) -> tuple[str, ...]:
    """Names of the estimated unknowns: camera, temperature terms, alignment, alignment rate."""
    estimated_names = set(estimated_parameters(options, model))
    rate = ALIGNMENT_NAMES if options.alignment_temperature else ()
    return (
        *(name for name in parameter_names(model) if name in estimated_names),
        *(f'focal_temperature_{i + 1}' for i in range(options.focal_temperature_order)),
        *ALIGNMENT_NAMES,
        *(f'{name}_temperature' for name in rate),
    )


def predicted_sigma(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Floats:
    """
    1-sigma (k,) of `estimated_names` that a calibration would report, predicted at the prior.

    Uses the covariances of centroids and star tracker as given, and the slow error of the star
    tracker to expect; infinite for parameters that are not observable yet.  Temperature terms that
    the images support are estimated jointly, so all sigmas account for them.
    """
    names = estimated_names(options, prior.camera.model)
    if not ensemble.images:
        return np.full(len(names), np.inf)
    order, with_rate, _ = supported_terms(
        ensemble, options.focal_temperature_order, options.alignment_temperature
    )
    found = _sigma_with(ensemble, prior, options, order, with_rate)
    if not found and (order or with_rate):
        # Sigmas without temperature terms, until images cover a wider range of temperatures.
        found = _sigma_with(ensemble, prior, options, 0, False)
    return np.array([found.get(name, np.inf) for name in names])


def _at_the_prior(
    ensemble: Ensemble,
    prior: CameraGeometry,
    options: CalibrationOptions,
    order: int,
    with_rate: bool,
) -> tuple[Problem, State, Layout, StarSums, bool]:
    """
    Return the initial state of a problem, its unknowns and the sums over its stars.

    The last value is True if all stars are in front of the camera.
    """
    problem = problem_of(ensemble, prior, options)
    state = start_of(problem, prior, order, with_rate)
    table = star_table(ensemble.images)
    enough = np.array([len(image) >= FEWEST for image in ensemble.images])
    measurements = arrange(table, enough[table.image], table.covariance_px2)
    layout = unknowns_in_state(problem, state)
    cost, sums = stars_alone(problem, state, layout, measurements)
    return problem, state, layout, sums, math.isfinite(cost)


def _sigma_with(
    ensemble: Ensemble,
    prior: CameraGeometry,
    options: CalibrationOptions,
    order: int,
    with_rate: bool,
) -> dict[str, float]:
    """1-sigma by name; empty if not observable."""
    problem, state, layout, sums, in_front = _at_the_prior(
        ensemble, prior, options, order, with_rate
    )
    if not in_front:
        return {}
    kept = estimated(layout)
    whole = information_of_images(sums, problem, state, layout).sum(axis=0)
    information = whole[np.ix_(kept, kept)] + np.diag(layout.prior_precision[kept])
    try:
        covariance = inverse(information)
    except (NotObservable, np.linalg.LinAlgError):
        return {}
    # Held unknowns with a prior sigma widen the sigmas of the others, as in the estimate.
    first = layout.places['camera'].start
    held = np.setdiff1d(first + np.flatnonzero(np.isfinite(problem.prior_sigma)), kept)
    by_held = covariance @ whole[np.ix_(kept, held)] * problem.prior_sigma[held - first]
    variance = np.diag(covariance) + (by_held**2).sum(axis=1)
    here = np.flatnonzero(problem.star_tracker == 0)
    if options.method != 'single' and len(here):  # 'single' takes star trackers as exact
        stamps_ns = np.array([ensemble.images[k].time_ns for k in here], np.int64)
        slow_rad = expected_slow_of_mean(
            correlations_of(stamps_ns, state.camera_from_icrf[here]),
            options.star_tracker_slow_arcsec * ARCSECOND_RAD,
            float(problem.star_tracker_sigma_rad.min()),
        )
        variance[np.isin(kept, layout.of(['alignment']))] += slow_rad**2
    names = [layout.labels[k] for k in kept]
    return dict(zip(names, np.sqrt(variance).tolist(), strict=True))


def ensemble_status(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> EnsembleStatus:
    """Counts, coverage and predicted sigmas of an ensemble."""
    return EnsembleStatus(
        time_ns=ensemble.images[-1].time_ns if ensemble.images else 0,
        images=len(ensemble.images),
        stars=ensemble.star_count,
        min_images=options.min_images,
        min_stars=options.min_stars,
        refused=dict(ensemble.refused),
        coverage=coverage(ensemble, prior.camera),
        parameter_names=estimated_names(options, prior.camera.model),
        predicted_sigma=predicted_sigma(ensemble, prior, options),
    )


def weakest_direction(information: Floats, names: tuple[str, ...]) -> tuple[Floats, str]:
    """
    Singular values of the scaled information, and its weakest direction as text.

    Parameters
    ----------
    information : (k, k)
        Information on the named parameters.

    Returns
    -------
    singular_values : (k,)
        Square roots of the eigenvalues of the information scaled to a unit diagonal, largest
        first.
    text : str
        Parameters that are nearly indistinguishable.
    """
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    singular = np.sqrt(np.maximum(values, 0.0))[::-1]
    direction = vectors[:, 0] * np.sign(vectors[np.abs(vectors[:, 0]).argmax(), 0])
    largest = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.3]
    terms = ', '.join(f'{names[i]} ({direction[i]:+.2f})' for i in largest)
    if len(largest) < 2:
        return singular, f'{terms}, uncorrelated with the others'
    worse = 1.0 / max(float(singular[-1]), 1e-300)
    return singular, (
        f'{terms} are nearly indistinguishable: their combination has {worse:.0f} times the sigma '
        'that it would have without correlation'
    )


def keep_most_informative(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Ensemble:
    """
    Ensemble without its least informative images, at most ``max_images``.

    Removes, one at a time, the image k with the least ``trace(total^-1 information_k)``.
    """
    if len(ensemble.images) <= options.max_images:
        return ensemble
    images = ensemble.images
    information = image_information(images, prior, options)
    while len(images) > options.max_images:
        total = information.sum(axis=0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
        inverse = np.linalg.pinv(total * scale[:, None] * scale[None, :], hermitian=True)
        worth = np.einsum('ij,mji->m', inverse * scale[:, None] * scale[None, :], information)
        least = int(worth.argmin())
        images = images[:least] + images[least + 1 :]
        information = np.delete(information, least, axis=0)
    return replace(ensemble, images=images)


def map_sigma_px(camera: CameraModel, covariance: MapCovariance) -> Floats:
    """1-sigma (GRID * GRID,) of the shape of the map, in pixels at the centre."""
    grid = grid_derivatives(camera)
    J = grid.of_shape(camera, common_rotation(camera, grid))
    shape_sigma_arcsec = sigma_arcsec(grid.covariance_rad2(covariance, J))
    return np.asarray(shape_sigma_arcsec * ARCSECOND_RAD * camera.parameters[0])


def detector_maps(camera: CameraModel, covariance: MapCovariance, pixels: Floats) -> DetectorMaps:
    """Maps of a camera and its covariance, which stars at pixels (n, 2) determined."""
    table = line_of_sight_table(camera, covariance, pixel_grid(camera, MAP_COLS, MAP_ROWS))
    return DetectorMaps(
        stars_in_cells(pixels, camera),
        table.sigma_arcsec.reshape(MAP_ROWS, MAP_COLS),
        table.shape_sigma_arcsec.reshape(MAP_ROWS, MAP_COLS),
    )


def correlation(covariance: Floats, names: tuple[str, ...]) -> Correlation:
    """Correlations of a covariance (k, k), without the rows of zero variance."""
    sigma = np.sqrt(np.diag(covariance))
    known = np.nonzero(sigma > 0)[0]
    matrix = covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
    return Correlation(tuple(names[i] for i in known), matrix)
