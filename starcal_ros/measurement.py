"""
Residuals of star observations and their normal matrices, image by image (Eqs. 15, 27-37).

For every image the residual and its derivatives by the ten camera parameters and by the small
rotation of that image are whitened by each star's covariance and multiplied into one (14, 14)
matrix: ``[J_camera J_rotation r]' [J_camera J_rotation r]``.  Every method of calibration is
assembled from those matrices, so the dense Jacobian of the ensemble is never formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcal_ros.camera import project_parameters
from starcal_ros.records import StarObservations

Floats = NDArray[np.float64]

CAMERA = slice(0, 10)
ROTATION = slice(10, 13)
RESIDUAL = 13
_CHUNK_STARS = 8192  # measured: calls into numpy cost more below, the cache more above


@dataclass(frozen=True)
class StarTable:
    """
    All stars of an ensemble as columns, in image order.

    ``image`` (n,) index of the image; ``catalog_id`` (n,); ``direction_icrf`` (n, 3);
    ``measured_px`` (n, 2); ``covariance_px2`` (n, 3) uu, uv, vv; ``image_count``.
    """

    image: NDArray[np.int64]
    catalog_id: NDArray[np.int64]
    direction_icrf: Floats
    measured_px: Floats
    covariance_px2: Floats
    image_count: int

    def __len__(self) -> int:
        """Return the number of star observations."""
        return len(self.image)


def star_table(images: Sequence[StarObservations]) -> StarTable:
    """Return the columns of all stars of the images."""
    counts = [len(observed) for observed in images]
    return StarTable(
        image=np.repeat(np.arange(len(images)), counts),
        catalog_id=np.concatenate([np.empty(0, np.int64), *(i.catalog_id for i in images)]),
        direction_icrf=np.concatenate([np.empty((0, 3)), *(i.direction_icrf for i in images)]),
        measured_px=np.concatenate([np.empty((0, 2)), *(i.measured_px for i in images)]),
        covariance_px2=np.concatenate([np.empty((0, 3)), *(i.covariance_px2 for i in images)]),
        image_count=len(images),
    )


@dataclass(frozen=True)
class _Chunk:
    """Some images of like star count, padded to the largest with stars of no weight."""

    image: NDArray[np.int64]  # (m,)
    direction_icrf: Floats  # (m, 3, n)
    measured_px: Floats  # (2, m, n)
    whitener: Floats  # (3, m, n): lower triangle of the inverse Cholesky factor, uu, vu, vv


@dataclass(frozen=True)
class Measurements:
    """Star observations laid out for `normal_blocks`."""

    chunks: tuple[_Chunk, ...]
    image_count: int


def whitening(covariance_px2: Floats) -> Floats:
    """
    Inverse Cholesky factors (3, n) of covariances (n, 3): uu, vu, vv of the lower triangle.

    With r the residual, ``(uu r_u, vu r_u + vv r_v)`` has unit covariance.
    """
    uu, uv, vv = covariance_px2.T
    root_uu = np.sqrt(uu)
    slope = uv / uu
    root_vv = np.sqrt(vv - slope * uv)
    return np.stack([1.0 / root_uu, -slope / root_vv, 1.0 / root_vv])


def arrange(table: StarTable, keep: NDArray[np.bool_], covariance_px2: Floats) -> Measurements:
    """
    Lay out the kept stars, (n,) mask, whitened by covariances (n, 3).

    Images of like size share a chunk, so that little is padded.
    """
    order = np.nonzero(keep)[0]
    counts = np.bincount(table.image[order], minlength=table.image_count)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    whitener = whitening(covariance_px2)
    images = np.argsort(counts, kind='stable')
    images = images[counts[images] > 0]
    chunks = []
    first = 0
    while first < len(images):
        # No image is padded by more than half, and none alone is too large for a chunk.
        like = counts[images] <= 1.5 * counts[images[first]] + 8
        fits = np.arange(1, len(images) - first + 1) * counts[images[first:]] <= _CHUNK_STARS
        last = first + max(1, int(np.count_nonzero(like[first:] & fits)))
        chosen = images[first:last]
        width = counts[chosen[-1]]
        slot = np.arange(width)
        real = slot[None, :] < counts[chosen, None]
        row = order[starts[chosen, None] + np.where(real, slot[None, :], 0)]
        chunks.append(
            _Chunk(
                image=chosen,
                direction_icrf=np.ascontiguousarray(table.direction_icrf[row].transpose(0, 2, 1)),
                measured_px=np.ascontiguousarray(table.measured_px[row].transpose(2, 0, 1)),
                whitener=np.where(real, whitener[:, row], 0.0),
            )
        )
        first = last
    return Measurements(tuple(chunks), table.image_count)


def normal_blocks(
    measurements: Measurements,
    parameters: Floats,
    camera_from_icrf: Floats,
    loss_scale: float = np.inf,
) -> tuple[float, Floats]:
    """
    Cost and the (14, 14) normal matrix of every image.

    Parameters
    ----------
    parameters : (10,) or (m, 10)
        Camera parameters of all images, or of each.
    camera_from_icrf : (m, 3, 3)
        Rotation of each image.
    loss_scale : float
        Cauchy loss ``c^2 log(1 + s / c^2)`` of the squared whitened residual s of a star;
        infinite: least squares.

    Returns
    -------
    cost : float
        Half the sum of the loss; infinite where a star would lie behind the camera.
    blocks : (m, 14, 14)
        Rows and columns: ten camera parameters, three angles, residual (measured - predicted).
        ``blocks[:, :13, 13]`` is downhill.
    """
    blocks = np.zeros((measurements.image_count, 14, 14))
    cost = 0.0
    largest = max((chunk.measured_px[0].size for chunk in measurements.chunks), default=0)
    # Fresh pages for every chunk would cost as much as the arithmetic on them.
    memory = np.empty(30 * largest)
    for chunk in measurements.chunks:
        m, n = chunk.measured_px[0].shape
        J_and_zero = memory[: 30 * m * n].reshape(m, 15, 2 * n)
        J = J_and_zero[:, :14]
        own = parameters if parameters.ndim == 1 else parameters[chunk.image].T[..., None]
        if not _whitened_columns(chunk, own, camera_from_icrf[chunk.image], J):
            return np.inf, blocks
        if np.isfinite(loss_scale):
            s = J[:, RESIDUAL, :n] ** 2 + J[:, RESIDUAL, n:] ** 2
            c2 = loss_scale**2
            cost += 0.5 * c2 * float(np.log1p(s / c2).sum())
            root_weight = 1.0 / np.sqrt(1.0 + s / c2)
            J *= np.concatenate([root_weight, root_weight], axis=-1)[:, None, :]
        # numpy takes A @ A.T to a routine for symmetric products, which for 14 rows is half as
        # fast as the general one: a row of zeros makes the factors differ.
        J_and_zero[:, 14] = 0.0
        blocks[chunk.image] = (J @ J_and_zero.transpose(0, 2, 1))[:, :, :14]
    if not np.isfinite(loss_scale):
        cost = 0.5 * float(blocks[:, RESIDUAL, RESIDUAL].sum())
    return cost, blocks


def _whitened_columns(
    chunk: _Chunk, parameters: Floats, camera_from_icrf: Floats, J: Floats
) -> bool:
    """
    Write the whitened derivatives and residuals of a chunk into J, (m, 14, 2n).

    The first n of the last axis are the u rows, the others the v rows.  False when a star is
    behind the camera.  ``parameters`` is (10,) or (10, m, 1).

    The columns are those of `camera.project_jacobians`, whitened as they are made and in place:
    most of the time of a calibration is spent here, in memory traffic.
    """
    e = camera_from_icrf @ chunk.direction_icrf
    z = e[:, 2]
    if z.min() <= 0:
        return False
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = parameters
    n = z.shape[1]
    U, V = J[:, :, :n], J[:, :, n:]
    scratch = np.empty_like(z)
    multiply = np.multiply
    wuu, wvu, wvv = chunk.whitener
    # Whitened rows by the distorted image plane: u = uu x' + uv y', v = vu x' + vv y'.
    uu, uv, vu, vv = wuu * fx, wuu * skew, wvu * fx, wvu * skew + wvv * fy

    def put(column: int, dx: Floats, dy: Floats) -> None:
        multiply(uu, dx, out=U[:, column])
        multiply(uv, dy, out=scratch)
        U[:, column] += scratch
        multiply(vu, dx, out=V[:, column])
        multiply(vv, dy, out=scratch)
        V[:, column] += scratch

    z_inverse = 1.0 / z
    x, y = e[:, 0] * z_inverse, e[:, 1] * z_inverse
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    xy_2, r2_2xx, r2_2yy = 2.0 * xy, r2 + 2.0 * xx, r2 + 2.0 * yy
    put(8, xy_2, r2_2yy)
    put(9, r2_2xx, xy_2)
    put(5, x, y)
    for W in (U, V):
        W[:, 5] *= r2
        multiply(W[:, 5], r2, out=W[:, 6])
        multiply(W[:, 6], r2, out=W[:, 7])

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
        (V, vu * x_x + vv * cross, vu * cross + vv * y_y),
    ):
        multiply(by_x, xy, out=W[:, 10])
        multiply(by_y, one_yy, out=scratch)
        W[:, 10] += scratch
        multiply(by_x, one_xx, out=W[:, 11])
        multiply(by_y, xy, out=scratch)
        W[:, 11] += scratch
        np.negative(W[:, 11], out=W[:, 11])
        multiply(by_x, y, out=W[:, 12])
        multiply(by_y, x, out=scratch)
        W[:, 12] -= scratch

    multiply(wuu, xd, out=U[:, 0])
    multiply(wvu, xd, out=V[:, 0])
    multiply(wuu, yd, out=U[:, 1])
    multiply(wvu, yd, out=V[:, 1])
    U[:, 2], U[:, 3], U[:, 4] = 0.0, wuu, 0.0
    multiply(wvv, yd, out=V[:, 2])
    V[:, 3], V[:, 4] = wvu, wvv
    u, v = chunk.measured_px
    residual_u = u - cx - fx * xd - skew * yd
    residual_v = v - cy - fy * yd
    multiply(wuu, residual_u, out=U[:, RESIDUAL])
    V[:, RESIDUAL] = wvu * residual_u + wvv * residual_v
    return True


def residuals_px(table: StarTable, parameters: Floats, camera_from_icrf: Floats) -> Floats:
    """Measured minus predicted pixels (n, 2) of every star; parameters (10,) or (m, 10)."""
    direction_camera = np.einsum('nij,nj->ni', camera_from_icrf[table.image], table.direction_icrf)
    own = parameters if parameters.ndim == 1 else parameters[table.image].T
    return np.asarray(table.measured_px - project_parameters(own, direction_camera))


def squared_sigmas(residual_px: Floats, covariance_px2: Floats) -> Floats:
    """Squared Mahalanobis length (n,) of residuals (n, 2) under covariances (n, 3)."""
    wuu, wvu, wvv = whitening(covariance_px2)
    u, v = residual_px.T
    return np.asarray((wuu * u) ** 2 + (wvu * u + wvv * v) ** 2)
