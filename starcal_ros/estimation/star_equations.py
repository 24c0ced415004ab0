# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Residuals of star observations and their normal matrices, image by image (Eqs. 15, 27-37).

For every image the residual and its derivatives by the p camera parameters and by the small
rotation of that image are whitened by each star's covariance and multiplied into one square
matrix of p + 4 rows: ``[J_camera J_rotation r]' [J_camera J_rotation r]``.  Every method of
calibration is assembled from those matrices, so the dense Jacobian of the ensemble is never
formed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.camera import ALL_PARAMETER_NAMES, project_parameters
from starcal_ros.camera.detector_field import DetectorField
from starcal_ros.camera.lens import (
    coefficient_jacobian,
    distort,
    distort_jacobian,
    ideal_by_rotation,
    ideal_points,
)
from starcal_ros.records import StarObservations

# Rows and columns of the matrix of an image; the camera's are as many as the model has parameters.
CAMERA = slice(0, -4)
ROTATION = slice(-4, -1)
RESIDUAL = -1
_CHUNK_STARS = 8192  # measured: calls into numpy cost more below, the cache more above


@dataclass(frozen=True)
class StarTable:
    """
    All stars of an ensemble as columns, in image order.

    ``image`` (n,) index of the image; ``catalog_id`` (n,); ``star`` (n,) index among the observed
    catalog stars; ``direction_icrf`` (n, 3); ``magnitude`` (n,);
    ``measured_px`` (n, 2); ``covariance_px2`` (n, 3) uu,
    uv, vv; ``image_count``.
    """

    image: NDArray[np.int64]
    catalog_id: NDArray[np.int64]
    star: NDArray[np.int64]
    direction_icrf: Floats
    magnitude: NDArray[np.float32]
    measured_px: Floats
    covariance_px2: Floats
    image_count: int

    def __len__(self) -> int:
        """Return the number of star observations."""
        return len(self.image)


def star_table(images: Sequence[StarObservations]) -> StarTable:
    """Return the columns of all stars of the images."""
    counts = [len(observed) for observed in images]
    catalog_id = np.concatenate([np.empty(0, np.int64), *(i.catalog_id for i in images)])
    return StarTable(
        image=np.repeat(np.arange(len(images)), counts),
        catalog_id=catalog_id,
        star=np.unique(catalog_id, return_inverse=True)[1],
        direction_icrf=np.concatenate([np.empty((0, 3)), *(i.direction_icrf for i in images)]),
        magnitude=np.concatenate([np.empty(0, np.float32), *(i.magnitude for i in images)]),
        measured_px=np.concatenate([np.empty((0, 2)), *(i.measured_px for i in images)]),
        covariance_px2=np.concatenate([np.empty((0, 3)), *(i.covariance_px2 for i in images)]),
        image_count=len(images),
    )


@dataclass(frozen=True)
class Chunk:
    """Some images of like star count, padded to the largest with stars of no weight."""

    image: NDArray[np.int64]  # (m,)
    row: NDArray[np.int64]  # (m n,) of the table; of stars of no weight, some other star
    direction_icrf: Floats  # (m, 3, n)
    measured_px: Floats  # (2, m n)
    whitener: Floats  # (3, m n): upper triangle, uu, uv, vv


@dataclass(frozen=True)
class Measurements:
    """Star observations laid out for `normal_blocks`."""

    chunks: tuple[Chunk, ...]
    image_count: int
    # Reused in every pass: allocating new pages takes as long as the arithmetic on them.
    derivatives: Floats


def whitening(covariance_px2: Floats) -> Floats:
    """
    Upper triangular whiteners (3, n) of covariances (n, 3): uu, uv, vv.

    With r the residual, ``(uu r_u + uv r_v, vv r_v)`` has unit covariance.
    """
    uu, uv, vv = covariance_px2.T
    slope = uv / vv
    root_uu = np.sqrt(uu - slope * uv)
    return np.stack([1.0 / root_uu, -slope / root_uu, 1.0 / np.sqrt(vv)])


def arrange(table: StarTable, keep: NDArray[np.bool_], covariance_px2: Floats) -> Measurements:
    """
    Lay out the kept stars, (n,) mask, whitened by covariances (n, 3).

    Images with similar star counts share a chunk, which limits the padding.
    """
    order = np.nonzero(keep)[0]
    counts = np.bincount(table.image[order], minlength=table.image_count)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    images = np.argsort(counts, kind='stable')
    images = images[counts[images] > 0]
    chunks = []
    first = 0
    while first < len(images):
        # Padding is at most half of an image; a single image always fits.
        like = counts[images] <= 1.5 * counts[images[first]] + 8
        fits = np.arange(1, len(images) - first + 1) * counts[images[first:]] <= _CHUNK_STARS
        last = first + max(1, int(np.count_nonzero(like[first:] & fits)))
        chosen = images[first:last]
        width = counts[chosen[-1]]
        slot = np.arange(width)
        real = slot[None, :] < counts[chosen, None]
        row = order[starts[chosen, None] + np.where(real, slot[None, :], 0)].ravel()
        direction_icrf = np.ascontiguousarray(table.direction_icrf[row].T)
        whitener = whitening(covariance_px2[row])
        whitener *= real.ravel()
        chunks.append(
            Chunk(
                chosen,
                row,
                direction_icrf.reshape(3, *real.shape).transpose(1, 0, 2),
                np.ascontiguousarray(table.measured_px[row].T),
                whitener,
            )
        )
        first = last
    largest = max((chunk.measured_px[0].size for chunk in chunks), default=0)
    # For the largest lens model; pages that a smaller one does not touch cost nothing.
    columns = len(ALL_PARAMETER_NAMES) + 5
    return Measurements(tuple(chunks), table.image_count, np.empty(2 * columns * largest))


def normal_blocks(
    measurements: Measurements,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    loss_scale: float = np.inf,
    field: DetectorField | None = None,
) -> tuple[float, Floats]:
    """
    Cost and the normal matrix of every image.

    Parameters
    ----------
    model : str
        Lens model, of `lens.COEFFICIENTS`.
    parameters : (p,) or (m, p)
        Camera parameters of all images, or of each.
    camera_from_icrf : (m, 3, 3)
        Rotation of each image.
    loss_scale : float
        Cauchy loss ``c^2 log(1 + s / c^2)`` of the squared whitened residual s of a star;
        infinite: least squares.
    field : DetectorField, optional
        Taken off the measured pixels.

    Returns
    -------
    cost : float
        Half the sum of the loss; infinite where a star would lie behind the camera.
    blocks : (m, p + 4, p + 4)
        Rows and columns: camera parameters, three angles, residual (measured - predicted).
        ``blocks[:, :-1, -1]`` is downhill.
    """
    rows = parameters.shape[-1] + 4
    blocks = np.zeros((measurements.image_count, rows, rows))
    cost = 0.0
    for chunk, J in whitened_chunks(measurements, model, parameters, camera_from_icrf, field):
        if J is None:
            return np.inf, blocks
        m, _, n = chunk.direction_icrf.shape
        if np.isfinite(loss_scale):
            s = J[0, rows - 1] ** 2 + J[1, rows - 1] ** 2
            c2 = loss_scale**2
            cost += 0.5 * c2 * float(np.log1p(s / c2).sum())
            J[:, :rows] *= 1.0 / np.sqrt(1.0 + s / c2)
        # numpy takes A @ A.T to a routine for symmetric products, which for 14 rows is half as
        # fast as the general one: with a row more it does not see that both factors are the same.
        by_image = J.reshape(2, rows + 1, m, n).transpose(0, 2, 1, 3)
        product = by_image[:, :, :rows] @ by_image.transpose(0, 1, 3, 2)
        blocks[chunk.image] = (product[0] + product[1])[..., :rows]
    if not np.isfinite(loss_scale):
        cost = 0.5 * float(blocks[:, RESIDUAL, RESIDUAL].sum())
    return cost, blocks


def whitened_chunks(
    measurements: Measurements,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    field: DetectorField | None = None,
) -> Iterator[tuple[Chunk, Floats | None]]:
    """
    Yield each chunk of m images of n stars with its whitened derivatives and residuals.

    They are (2, p + 5, m n): the u and the v rows of the columns of `normal_blocks`, and a column
    of zeros; None where the camera model has no image of a star.  The next chunk overwrites them.
    """
    whitened_columns = _plumb_bob_columns if model == 'plumb_bob' else _lens_columns
    columns = parameters.shape[-1] + 5
    for chunk in measurements.chunks:
        m, _, n = chunk.direction_icrf.shape
        J = measurements.derivatives[: 2 * columns * m * n].reshape(2, columns, m * n)
        own = parameters
        if parameters.ndim > 1:
            own = np.repeat(parameters[chunk.image], n, axis=0).T
        ideal = chunk
        if field is not None:
            off_px = field.displacement_px(chunk.measured_px.T).T
            ideal = dataclasses.replace(chunk, measured_px=chunk.measured_px - off_px)
        seen = whitened_columns(ideal, model, own, camera_from_icrf[chunk.image], J)
        yield chunk, (J if seen else None)


def _lens_columns(
    chunk: Chunk, model: str, parameters: Floats, camera_from_icrf: Floats, J: Floats
) -> bool:
    """
    Write the whitened derivatives and residuals of a chunk into J, (2, p + 5, m n).

    The first axis is the u and the v rows; the last of the second is zero.  False when the camera
    model has no image of a star.  ``parameters`` is (p,) or (p, m n).
    """
    m, _, n = chunk.direction_icrf.shape
    e = (camera_from_icrf @ chunk.direction_icrf).transpose(0, 2, 1).reshape(m * n, 3)
    ideal = ideal_points(model, e)
    fx, skew, fy, cx, cy = parameters[:5]
    coefficients = parameters[5:]
    xd, yd = distort(model, ideal, coefficients).T
    if not np.isfinite(xd).all():
        return False
    p = len(parameters)
    wuu, wuv, wvv = chunk.whitener
    # Whitened rows by the distorted image plane: u = uu x' + uv y', v = vv y'.
    uu, uv, vv = wuu * fx, wuu * skew + wuv * fy, wvv * fy
    J[...] = 0.0
    J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4] = wuu * xd, wuu * yd, wuv * yd, wuu, wuv
    J[1, 2], J[1, 4] = wvv * yd, wvv
    by_x, by_y = coefficient_jacobian(model, ideal, coefficients)
    J[0, 5:p] = uu * by_x + uv * by_y
    J[1, 5:p] = vv * by_y
    J_ideal = distort_jacobian(model, ideal, coefficients)
    x_theta, y_theta = ideal_by_rotation(model, ideal)
    by_x, by_y = ((J_ideal[:, k, :1] * x_theta + J_ideal[:, k, 1:] * y_theta).T for k in (0, 1))
    J[0, p : p + 3] = uu * by_x + uv * by_y
    J[1, p : p + 3] = vv * by_y
    u, v = chunk.measured_px
    residual_u = u - cx - fx * xd - skew * yd
    residual_v = v - cy - fy * yd
    J[0, p + 3] = wuu * residual_u + wuv * residual_v
    J[1, p + 3] = wvv * residual_v
    return True


def _plumb_bob_columns(
    chunk: Chunk, model: str, parameters: Floats, camera_from_icrf: Floats, J: Floats
) -> bool:
    """
    Write the same as `_lens_columns` for ``plumb_bob``, in half the time.

    The columns are those of `camera.project_jacobians`, whitened in place: most of the
    time of a calibration is spent here, in memory traffic.
    """
    del model
    m, _, n = chunk.direction_icrf.shape
    e = np.empty((3, m, n))
    np.matmul(camera_from_icrf, chunk.direction_icrf, out=e.transpose(1, 0, 2))
    e_x, e_y, e_z = e.reshape(3, m * n)
    if e_z.min() <= 0:
        return False
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = parameters
    U, V = J
    scratch = np.empty_like(e_z)
    multiply = np.multiply
    wuu, wuv, wvv = chunk.whitener
    # Whitened rows by the distorted image plane: u = uu x' + uv y', v = vv y'.
    uu, uv, vv = wuu * fx, wuu * skew + wuv * fy, wvv * fy

    def put(column: int, dx: Floats, dy: Floats) -> None:
        multiply(uu, dx, out=U[column])
        U[column] += multiply(uv, dy, out=scratch)
        multiply(vv, dy, out=V[column])

    x, y = e_x / e_z, e_y / e_z
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    xy_2, r2_2xx, r2_2yy = 2.0 * xy, r2 + 2.0 * xx, r2 + 2.0 * yy
    put(8, xy_2, r2_2yy)
    put(9, r2_2xx, xy_2)
    put(5, x, y)
    for W in (U, V):
        W[5] *= r2
        multiply(W[5], r2, out=W[6])
        multiply(W[6], r2, out=W[7])

    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    g_r2 = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))
    xd = g * x + p1 * xy_2 + p2 * r2_2xx
    yd = g * y + p1 * r2_2yy + p2 * xy_2
    cross = xy * g_r2 + (2.0 * p1) * x + (2.0 * p2) * y
    x_x = xx * g_r2 + g + (2.0 * p1) * y + (6.0 * p2) * x
    y_y = yy * g_r2 + g + (6.0 * p1) * y + (2.0 * p2) * x
    one_xx, one_yy = 1.0 + xx, 1.0 + yy
    for W, by_x, by_y in (
        (U, uu * x_x + uv * cross, uu * cross + uv * y_y),
        (V, vv * cross, vv * y_y),
    ):
        multiply(by_x, xy, out=W[10])
        W[10] += multiply(by_y, one_yy, out=scratch)
        multiply(by_x, one_xx, out=W[11])
        W[11] += multiply(by_y, xy, out=scratch)
        np.negative(W[11], out=W[11])
        multiply(by_x, y, out=W[12])
        W[12] -= multiply(by_y, x, out=scratch)

    multiply(wuu, xd, out=U[0])
    multiply(wuu, yd, out=U[1])
    multiply(wuv, yd, out=U[2])
    U[3], U[4] = wuu, wuv
    V[:2], V[3] = 0.0, 0.0
    multiply(wvv, yd, out=V[2])
    V[4] = wvv
    u, v = chunk.measured_px
    residual_u = u - cx - fx * xd - skew * yd
    residual_v = v - cy - fy * yd
    U[13] = wuu * residual_u + wuv * residual_v
    multiply(wvv, residual_v, out=V[13])
    J[:, 14] = 0.0
    return True


def residuals_px(
    table: StarTable,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    field: DetectorField | None = None,
) -> Floats:
    """Measured minus predicted pixels (n, 2) of every star; parameters (p,) or (m, p)."""
    residual_px = table.measured_px.copy()
    if field is not None:
        residual_px -= field.displacement_px(table.measured_px)
    # In parts: a rotation for each of all stars would be most of the memory of a calibration.
    for first in range(0, len(table), _CHUNK_STARS):
        part = slice(first, first + _CHUNK_STARS)
        image = table.image[part]
        direction_camera = np.einsum(
            'nij,nj->ni', camera_from_icrf[image], table.direction_icrf[part]
        )
        own = parameters if parameters.ndim == 1 else parameters[image].T
        residual_px[part] -= project_parameters(model, own, direction_camera)
    return residual_px


def squared_sigmas(residual_px: Floats, covariance_px2: Floats) -> Floats:
    """Squared Mahalanobis length (n,) of residuals (n, 2) under covariances (n, 3)."""
    wuu, wuv, wvv = whitening(covariance_px2)
    u, v = residual_px.T
    return np.asarray((wuu * u + wuv * v) ** 2 + (wvv * v) ** 2)
