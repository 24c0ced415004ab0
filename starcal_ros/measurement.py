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
_CHUNK_STARS = 2048  # columns of one chunk stay in the second-level cache


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
        last = first + 1
        while last < len(images) and (last + 1 - first) * counts[images[last]] <= _CHUNK_STARS:
            last += 1
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
    parameters : (10,)
        Camera parameters.
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
    for chunk in measurements.chunks:
        J, s = _whitened_columns(chunk, parameters, camera_from_icrf[chunk.image])
        if J is None:
            return np.inf, blocks
        if np.isfinite(loss_scale):
            c2 = loss_scale**2
            cost += 0.5 * c2 * float(np.log1p(s / c2).sum())
            root_weight = 1.0 / np.sqrt(1.0 + s / c2)
            J *= np.concatenate([root_weight, root_weight], axis=-1)[:, None, :]
        else:
            cost += 0.5 * float(s.sum())
        blocks[chunk.image] = J @ J.transpose(0, 2, 1)
    return cost, blocks


def _whitened_columns(
    chunk: _Chunk, parameters: Floats, camera_from_icrf: Floats
) -> tuple[Floats | None, Floats]:
    """
    Whitened derivatives and residuals (m, 14, 2n) of a chunk, and squared residuals (m, n).

    The first n of the last axis are the u rows, the others the v rows.  None when a star is
    behind the camera.  The columns are those of `camera.project_jacobians`, written one by one
    where the matrix product wants them.
    """
    e = camera_from_icrf @ chunk.direction_icrf
    z = e[:, 2]
    if z.min() <= 0:
        return None, z
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = parameters
    x, y = e[:, 0] / z, e[:, 1] / z
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    r4 = r2 * r2
    r6 = r4 * r2
    g = 1.0 + k1 * r2 + k2 * r4 + k3 * r6
    xy2 = 2.0 * xy
    r2_xx = r2 + 2.0 * xx
    r2_yy = r2 + 2.0 * yy
    xd = g * x + p1 * xy2 + p2 * r2_xx
    yd = g * y + p1 * r2_yy + p2 * xy2
    g2 = 2.0 * (k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4)
    cross = xy * g2 + 2.0 * (p1 * x + p2 * y)
    x_x = g + xx * g2 + 2.0 * p1 * y + 6.0 * p2 * x
    y_y = g + yy * g2 + 6.0 * p1 * y + 2.0 * p2 * x
    u_x, u_y = fx * x_x + skew * cross, fx * cross + skew * y_y
    v_x, v_y = fy * cross, fy * y_y

    wuu, wvu, wvv = chunk.whitener
    m, n = z.shape
    J = np.empty((m, 14, 2 * n))

    def put(column: int, du: Floats, dv: Floats) -> None:
        np.multiply(wuu, du, out=J[:, column, :n])
        J[:, column, n:] = wvu * du + wvv * dv

    def put_distortion(column: int, dx: Floats, dy: Floats) -> None:
        put(column, fx * dx + skew * dy, fy * dy)

    J[:, 0, :n], J[:, 0, n:] = wuu * xd, wvu * xd
    J[:, 1, :n], J[:, 1, n:] = wuu * yd, wvu * yd
    J[:, 2, :n], J[:, 2, n:] = 0.0, wvv * yd
    J[:, 3, :n], J[:, 3, n:] = wuu, wvu
    J[:, 4, :n], J[:, 4, n:] = 0.0, wvv
    put_distortion(5, r2 * x, r2 * y)
    put_distortion(6, r4 * x, r4 * y)
    put_distortion(7, r6 * x, r6 * y)
    put_distortion(8, xy2, r2_yy)
    put_distortion(9, r2_xx, xy2)
    one_xx, one_yy = 1.0 + xx, 1.0 + yy
    put(10, u_x * xy + u_y * one_yy, v_x * xy + v_y * one_yy)
    put(11, -u_x * one_xx - u_y * xy, -v_x * one_xx - v_y * xy)
    put(12, u_x * y - u_y * x, v_x * y - v_y * x)
    u, v = chunk.measured_px
    put(RESIDUAL, u - (fx * xd + skew * yd + cx), v - (fy * yd + cy))
    s = J[:, RESIDUAL, :n] ** 2 + J[:, RESIDUAL, n:] ** 2
    return J, s


def residuals_px(table: StarTable, parameters: Floats, camera_from_icrf: Floats) -> Floats:
    """Measured minus predicted pixels (n, 2) of every star of the table."""
    direction_camera = np.einsum('nij,nj->ni', camera_from_icrf[table.image], table.direction_icrf)
    return np.asarray(table.measured_px - project_parameters(parameters, direction_camera))


def squared_sigmas(residual_px: Floats, covariance_px2: Floats) -> Floats:
    """Squared Mahalanobis length (n,) of residuals (n, 2) under covariances (n, 3)."""
    wuu, wvu, wvv = whitening(covariance_px2)
    u, v = residual_px.T
    return np.asarray((wuu * u) ** 2 + (wvu * u + wvv * v) ** 2)
