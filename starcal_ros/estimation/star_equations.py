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
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.camera.lens import ideal_by_rotation, ideal_points, LENSES
from starcal_ros.estimation.limits import ROWS_AT_ONCE
from starcal_ros.records import StarObservations

ROTATION = slice(-4, -1)
"""Rows and columns of the matrix of an image for its rotation; the last are those of the
residual."""


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
    _room: list[Floats] = field(default_factory=list)

    def derivatives(self, chunk: Chunk, columns: int) -> Floats:
        """
        Return an array (2, columns, m n) for a chunk, which the next call overwrites.

        Its memory is kept from pass to pass: new pages take as long as the arithmetic on them.
        """
        size = 2 * columns * max(one.measured_px[0].size for one in self.chunks)
        if not self._room or self._room[0].size < size:
            self._room[:] = [np.empty(size)]
        stars = chunk.measured_px[0].size
        return self._room[0][: 2 * columns * stars].reshape(2, columns, stars)


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
        fits = np.arange(1, len(images) - first + 1) * counts[images[first:]] <= ROWS_AT_ONCE
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
    return Measurements(tuple(chunks), table.image_count)


def normal_blocks(
    measurements: Measurements,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    loss_scale: float = np.inf,
) -> tuple[float, Floats]:
    """
    Cost and the normal matrix of every image.

    Parameters
    ----------
    model : str
        Lens model, of `lens.LENSES`.
    parameters : (p,) or (m, p)
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
    blocks : (m, p + 4, p + 4)
        Rows and columns: camera parameters, three angles, residual (measured - predicted).
        ``blocks[:, :-1, -1]`` is downhill.
    """
    rows = parameters.shape[-1] + 4
    blocks = np.zeros((measurements.image_count, rows, rows))
    cost = 0.0
    for chunk, J in whitened_chunks(measurements, model, parameters, camera_from_icrf):
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
        cost = 0.5 * float(blocks[:, -1, -1].sum())
    return cost, blocks


def whitened_chunks(
    measurements: Measurements,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    turns: int = 0,
) -> Iterator[tuple[Chunk, Floats | None]]:
    """
    Yield each chunk of m images of n stars with its whitened derivatives and residuals.

    They are (2, p + turns + 5, m n): the u and the v rows of the columns of `normal_blocks`, with
    room for turns before the rotations, and a column of zeros; None where the camera model has no
    image of a star.  The next chunk overwrites them.
    """
    columns = parameters.shape[-1] + turns + 5
    for chunk in measurements.chunks:
        J, own = measurements.derivatives(chunk, columns), parameters
        if parameters.ndim > 1:
            own = np.repeat(parameters[chunk.image], chunk.direction_icrf.shape[2], axis=0).T
        seen = _whitened_columns(chunk, model, own, camera_from_icrf[chunk.image], J)
        yield chunk, (J if seen else None)


def _whitened_columns(
    chunk: Chunk, model: str, parameters: Floats, camera_from_icrf: Floats, J: Floats
) -> bool:
    """
    Write the whitened derivatives and residuals of a chunk into J, as `whitened_chunks`.

    The first axis is the u and the v rows; the last of the second is zero.  False when the camera
    model has no image of a star.  ``parameters`` is (p,) or (p, m n).
    """
    m, _, n = chunk.direction_icrf.shape
    e = np.empty((3, m, n))
    np.matmul(camera_from_icrf, chunk.direction_icrf, out=e.transpose(1, 0, 2))
    ideal = ideal_points(model, e.reshape(3, m * n).T)
    fx, skew, fy, cx, cy = parameters[:5]
    coefficients = parameters[5:]
    lens = LENSES[model]
    xd, yd = lens.distort(ideal, coefficients).T
    if not np.isfinite(xd).all():
        return False
    p = len(parameters)
    wuu, wuv, wvv = chunk.whitener
    # Whitened rows by the distorted image plane: u = uu x' + uv y', v = vv y'.
    uu, uv, vv = wuu * fx, wuu * skew + wuv * fy, wvv * fy
    U, V = J
    U[0], U[1], U[2], U[3], U[4] = wuu * xd, wuu * yd, wuv * yd, wuu, wuv
    V[:2], V[2], V[3], V[4] = 0.0, wvv * yd, 0.0, wvv
    by_x, by_y = lens.by_coefficients(ideal, coefficients)
    np.multiply(uu, by_x, out=U[5:p])
    U[5:p] += uv * by_y
    np.multiply(vv, by_y, out=V[5:p])
    (x_x, x_y), (y_x, y_y) = lens.by_ideal(ideal, coefficients).transpose(1, 2, 0)
    x_theta, y_theta = ideal_by_rotation(model, ideal).transpose(0, 2, 1)
    rotation = slice(-5, -2)
    for W, of_x, of_y in ((U, uu * x_x + uv * y_x, uu * x_y + uv * y_y), (V, vv * y_x, vv * y_y)):
        np.multiply(of_x, x_theta, out=W[rotation])
        W[rotation] += of_y * y_theta
    u, v = chunk.measured_px
    residual_u = u - cx - fx * xd - skew * yd
    residual_v = v - cy - fy * yd
    U[-2] = wuu * residual_u + wuv * residual_v
    np.multiply(wvv, residual_v, out=V[-2])
    J[:, -1] = 0.0
    return True


def squared_sigmas(residual_px: Floats, covariance_px2: Floats) -> Floats:
    """Squared Mahalanobis length (n,) of residuals (n, 2) under covariances (n, 3)."""
    wuu, wuv, wvv = whitening(covariance_px2)
    u, v = residual_px.T
    return np.asarray((wuu * u + wuv * v) ** 2 + (wvv * v) ** 2)
