"""What an ensemble can tell: information, predicted sigmas, coverage, line-of-sight map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.calibration import CalibrationOptions
from starcal_ros.camera import (
    CameraModel,
    line_of_sight,
    PARAMETER_NAMES,
    pixel_grid,
    project_jacobians,
)
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.measurement import arrange, CAMERA, normal_blocks, ROTATION, star_table
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    Ensemble,
    EnsembleStatus,
    StarObservations,
)

Floats = NDArray[np.float64]

COVERAGE_ROWS, COVERAGE_COLS = 8, 10  # cells of 2 degrees on the paper's camera
MAP_ROWS, MAP_COLS = 16, 20  # of a smooth surface of degree seven


def coverage(ensemble: Ensemble, camera: CameraModel) -> NDArray[np.int64]:
    """Star observations in each focal-plane cell, (8, 10)."""
    return stars_in_cells(star_table(ensemble.images).measured_px, camera)


def stars_in_cells(pixels: Floats, camera: CameraModel) -> NDArray[np.int64]:
    """Pixels (n, 2) in each focal-plane cell, (8, 10)."""
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
    Information (m, k, k) of each image on the k estimated camera parameters.

    The rotation of each image is free and eliminated (Schur complement), as in ``per_image``; an
    image with fewer than two stars tells nothing.
    """
    table = star_table(images)
    free = np.sort([PARAMETER_NAMES.index(name) for name in options.estimate])
    rotations = (
        Rotation.from_quat(prior.star_tracker_from_camera_xyzw).inv()
        * Rotation.from_quat(np.array([i.icrf_from_star_tracker_xyzw for i in images])).inv()
    )
    _, blocks = normal_blocks(
        arrange(table, np.ones(len(table), bool), table.covariance_px2),
        prior.camera.parameters,
        rotations.as_matrix(),
    )
    A = blocks[:, CAMERA, CAMERA][:, free][:, :, free]
    B = blocks[:, ROTATION, CAMERA][:, :, free]
    C = blocks[:, ROTATION, ROTATION]
    # An image without two stars before the camera tells nothing.
    seen = np.array([len(image) >= 2 for image in images]) & C.any(axis=(1, 2))
    information = np.zeros_like(A)
    if seen.any():
        information[seen] = A[seen] - B[seen].transpose(0, 2, 1) @ np.linalg.solve(
            C[seen], B[seen]
        )
    return information


def predicted_sigma(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Floats:
    """
    1-sigma (k,) of the estimated camera parameters, in `PARAMETER_NAMES` order, before solving.

    From the centroid covariances at the prior geometry; infinite where not observable yet.
    """
    count = len(options.estimate)
    if not ensemble.images:
        return np.full(count, np.inf)
    information = image_information(ensemble.images, prior, options).sum(axis=0)
    diagonal = np.diag(information)
    if (diagonal <= 0).any():
        return np.full(count, np.inf)
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    if values[0] < 1e-12:
        return np.full(count, np.inf)
    return np.asarray(scale * np.sqrt((vectors**2 / values).sum(axis=1)))


def ensemble_status(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> EnsembleStatus:
    """What has been collected and what a calibration from it would be worth."""
    names = tuple(name for name in PARAMETER_NAMES if name in options.estimate)
    alignment = np.full(3, np.inf)
    if ensemble.images:
        # The attitude noise of the images, averaged: the star field within an image adds little.
        tracker = np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD
        alignment = np.full(3, np.sqrt(np.mean(tracker**2) / len(ensemble.images)))
    return EnsembleStatus(
        time_ns=ensemble.images[-1].time_ns if ensemble.images else 0,
        images=len(ensemble.images),
        stars=ensemble.star_count,
        min_images=options.min_images,
        min_stars=options.min_stars,
        refused=dict(ensemble.refused),
        coverage=coverage(ensemble, prior.camera),
        parameter_names=names + ALIGNMENT_NAMES,
        predicted_sigma=np.concatenate([predicted_sigma(ensemble, prior, options), alignment]),
    )


def weakest_direction(information: Floats, names: tuple[str, ...]) -> tuple[Floats, str]:
    """
    Singular values of scaled information, and what it tells least of, in words.

    Parameters
    ----------
    information : (k, k)
        On the named parameters.

    Returns
    -------
    singular_values : (k,)
        Of the information scaled to a unit diagonal, largest first: square roots of its
        eigenvalues.
    text : str
        Which parameters can hardly be told apart.
    """
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    singular = np.sqrt(np.maximum(values, 0.0))[::-1]
    direction = vectors[:, 0] * np.sign(vectors[np.abs(vectors[:, 0]).argmax(), 0])
    largest = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.3]
    terms = ', '.join(f'{names[i]} ({direction[i]:+.2f})' for i in largest)
    if len(largest) < 2:
        return singular, f'{terms} is known least, and by itself'
    worse = 1.0 / max(float(singular[-1]), 1e-300)
    return singular, (
        f'{terms} can hardly be told apart: together they are known {worse:.0f} times worse than '
        'each would be alone'
    )


def keep_most_informative(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Ensemble:
    """
    The ensemble without its least informative images, down to ``max_images``.

    One by one the image goes whose information weighs least against that of all:
    ``trace(total^-1 information_k)``.
    """
    images = ensemble.images
    while len(images) > options.max_images:
        information = image_information(images, prior, options)
        total = information.sum(axis=0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
        inverse = np.linalg.pinv(total * scale[:, None] * scale[None, :], hermitian=True)
        worth = np.einsum('ij,mji->m', inverse * scale[:, None] * scale[None, :], information)
        least = int(worth.argmin())
        images = images[:least] + images[least + 1 :]
    return replace(ensemble, images=images)


def line_of_sight_sigma_arcsec(
    camera: CameraModel, covariance: Floats, columns: int = 25, rows: int = 20
) -> Floats:
    """
    1-sigma (rows, columns) of the line of sight of pixels in the star tracker frame, arcsec.

    Root of the summed variance of the two angles, from the (13, 13) covariance of camera and
    alignment.
    """
    _, J = _line_of_sight_jacobian(camera, columns, rows)
    variance = np.einsum('nij,jk,nik->n', J, covariance, J)
    return np.asarray(np.sqrt(variance).reshape(rows, columns) / ARCSECOND_RAD)


def map_sigma_px(camera: CameraModel, covariance: Floats, columns: int = 25) -> Floats:
    """1-sigma (columns * columns,) of `shape_sigma_rad`, in pixels at the centre."""
    sigma_rad = shape_sigma_rad(camera, covariance, columns, columns)
    return np.asarray(sigma_rad.ravel() * camera.parameters[0])


def shape_sigma_rad(
    camera: CameraModel, covariance: Floats, columns: int = 25, rows: int = 20
) -> Floats:
    """
    1-sigma (rows, columns) of the shape of the distortion map at a grid of pixels, rad.

    What a turn common to all pixels can take up (pointing, and most of a moved principal point) is
    removed: it belongs to the alignment.
    """
    directions, J = _line_of_sight_jacobian(camera, columns, rows)
    J = J[:, :, :10].reshape(-1, 10)
    turns = np.stack([np.cross(axis, directions) for axis in np.eye(3)], axis=-1)
    Q, _ = np.linalg.qr(turns.reshape(-1, 3))
    J = (J - Q @ (Q.T @ J)).reshape(-1, 3, 10)
    variance = np.einsum('nij,jk,nik->n', J, covariance[:10, :10], J)
    return np.asarray(np.sqrt(variance).reshape(rows, columns))


def detector_maps(camera: CameraModel, covariance: Floats, pixels: Floats) -> DetectorMaps:
    """Maps of a camera with a covariance (13, 13) that is from stars at pixels (n, 2)."""
    return DetectorMaps(
        stars_in_cells(pixels, camera),
        line_of_sight_sigma_arcsec(camera, covariance, MAP_COLS, MAP_ROWS),
        shape_sigma_rad(camera, covariance, MAP_COLS, MAP_ROWS) / ARCSECOND_RAD,
    )


def correlation(covariance: Floats, names: tuple[str, ...]) -> Correlation:
    """Correlations of the named numbers of a covariance (k, k), those left out that have none."""
    sigma = np.sqrt(np.diag(covariance))
    known = np.nonzero(sigma > 0)[0]
    matrix = covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
    return Correlation(tuple(names[i] for i in known), matrix)


def _line_of_sight_jacobian(camera: CameraModel, columns: int, rows: int) -> tuple[Floats, Floats]:
    """
    Lines of sight (n, 3) of a grid of pixels, and their derivatives (n, 3, 13).

    By the camera parameters and the alignment angles, in the camera frame.  For a fixed pixel:
    a direction moves so as to undo what the parameter does to its image.
    """
    directions = line_of_sight(camera, pixel_grid(camera, columns, rows))
    _, J_parameters, J_rotation = project_jacobians(camera, directions)
    # A turn about the line of sight itself moves nothing: the pseudo-inverse leaves it out.
    angles = np.linalg.pinv(J_rotation) @ J_parameters
    angles = np.concatenate([angles, np.broadcast_to(np.eye(3), (len(angles), 3, 3))], axis=-1)
    moved = np.cross(directions[:, None, :], np.swapaxes(angles, 1, 2))
    return directions, -np.swapaxes(moved, 1, 2)
