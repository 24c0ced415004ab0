# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Displacements that a calibration has no unknown for: their gradient and information.

A term is a displacement of the stars on the detector, linear in one coefficient: a smooth field,
a step between two halves of the detector, a wrong velocity of the observer.  At the minimum of a
calibration the terms are tested without another search: the rotations of the images and the
unknowns that the images share are eliminated from the normal equations, and what is left of
gradient and information decides (Rao's score test).  A search that estimates coefficients borders
its normal equations with the same sums.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.detector_field import DetectorField
from starcal_ros.least_squares.levenberg_marquardt import inverse, NormalEquations, NotObservable
from starcal_ros.least_squares.normal_equations import Measurements, whitened_chunks

Displacement = Callable[[Floats, Floats, NDArray[np.int64]], Floats]
"""Displacements (2, q, n) px of q unit terms, from pixels (2, n), directions in the camera frame
(3, n) and the index of the image of each star (n,)."""


Scalars = Callable[[Floats], Floats]
"""Values (t, n) of t functions at pixels (2, n): each displaces u with one coefficient, v with
another."""


@dataclass(frozen=True)
class LinearTerms:
    """
    Sums of q terms over the stars of m images, in the metric of the centroids.

    ``information`` (q, q); ``cross`` (m, q, k + 4) with the k camera parameters, the rotation of
    the image and the residual, in the columns of `normal_equations.normal_blocks`.
    """

    information: Floats
    cross: Floats

    def in_modes(self, modes: Floats) -> LinearTerms:
        """Return the sums of r combinations of the terms, ``modes`` (q, r)."""
        return LinearTerms(modes.T @ self.information @ modes, modes.T @ self.cross)


def linear_terms(
    measurements: Measurements,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    displacement: Displacement,
    field: DetectorField | None = None,
) -> LinearTerms:
    """Return the sums of terms at a state, which is given as to `normal_blocks`."""
    information: Floats = np.zeros((0, 0))
    cross: Floats = np.zeros((0, 0, 0))
    for chunk, J in whitened_chunks(measurements, model, parameters, camera_from_icrf, field):
        if J is None:
            raise NotObservable('a star has no image')
        m, _, n = chunk.direction_icrf.shape
        directions = camera_from_icrf[chunk.image] @ chunk.direction_icrf
        moved = displacement(
            chunk.measured_px,
            directions.transpose(1, 0, 2).reshape(3, m * n),
            np.repeat(chunk.image, n),
        )
        wuu, wuv, wvv = chunk.whitener
        U = wuu * moved[0]
        U += wuv * moved[1]
        V = wvv * moved[1]
        if not information.size:
            information = np.zeros((len(U), len(U)))
            cross = np.zeros((measurements.image_count, len(U), J.shape[1] - 1))
        information += U @ U.T
        information += V @ V.T
        for W, columns in ((U, J[0]), (V, J[1])):
            by_image = W.reshape(len(U), m, n).transpose(1, 0, 2)
            cross[chunk.image] += by_image @ columns[:-1].reshape(-1, m, n).transpose(1, 2, 0)
    return LinearTerms(information, cross)


def scalar_terms(
    measurements: Measurements,
    model: str,
    parameters: Floats,
    camera_from_icrf: Floats,
    scalars: Scalars,
    field: DetectorField | None = None,
    information: Floats | None = None,
) -> LinearTerms:
    """
    Return the sums of 2 t terms, those of u, then those of v: a quarter of the work.

    ``information`` is that of an earlier call with the same measurements and functions: it does
    not depend on the state.
    """
    uu: Floats = np.zeros((0, 0))
    uv, vv, cross = uu, uu, np.zeros((0, 0, 0))
    for chunk, J in whitened_chunks(measurements, model, parameters, camera_from_icrf, field):
        if J is None:
            raise NotObservable('a star has no image')
        m, _, n = chunk.direction_icrf.shape
        phi = scalars(chunk.measured_px)
        t = len(phi)
        wuu, wuv, wvv = chunk.whitener
        if not uu.size:
            uu, uv, vv = np.zeros((3, t, t))
            cross = np.zeros((measurements.image_count, 2 * t, J.shape[1] - 1))
        if information is None:
            uu += (phi * wuu**2) @ phi.T
            uv += (phi * (wuu * wuv)) @ phi.T
            vv += (phi * (wuv**2 + wvv**2)) @ phi.T
        by_image = phi.reshape(t, m, n).transpose(1, 0, 2)
        for part, columns in (
            (slice(0, t), wuu * J[0, :-1]),
            (slice(t, 2 * t), wuv * J[0, :-1] + wvv * J[1, :-1]),
        ):
            cross[chunk.image, part] = by_image @ columns.reshape(-1, m, n).transpose(1, 2, 0)
    if information is None:
        information = np.block([[uu, uv], [uv, vv]])
    return LinearTerms(information, cross)


@dataclass(frozen=True)
class Border:
    """Terms (q) as a border of normal equations of p shared unknowns and m blocks of three."""

    information: Floats  # (q, q)
    gradient: Floats  # (q,)
    shared: Floats  # (q, p)
    blocks: Floats  # (m, 3, q)


def bordered(normal: NormalEquations, border: Border) -> NormalEquations:
    """Return the normal equations of the shared unknowns, then the terms, and the blocks."""
    return NormalEquations(
        normal.cost,
        np.block([[normal.A, border.shared.T], [border.shared, border.information]]),
        np.concatenate([normal.a, border.gradient]),
        np.concatenate([normal.B, border.blocks], axis=2),
        normal.C,
        normal.c,
    )


@dataclass(frozen=True)
class Score:
    """
    What the stars show of q terms, all other unknowns free to answer.

    ``gradient`` (q,) and ``information`` (q, q): the estimate of the terms is
    ``information^-1 gradient``, its covariance ``information^-1``.
    """

    gradient: Floats
    information: Floats

    def single(self) -> tuple[Floats, Floats]:
        """Estimate (q,) and 1-sigma (q,) of each term alone; infinite sigma: not observable."""
        diagonal = np.diag(self.information)
        seen = diagonal > 0
        sigma = np.full(len(diagonal), np.inf)
        sigma[seen] = 1.0 / np.sqrt(diagonal[seen])
        return np.where(seen, self.gradient / np.where(seen, diagonal, 1.0), 0.0), sigma


def score(normal: NormalEquations, border: Border) -> Score:
    """
    Return the score of terms at a state, the unknowns of the normal equations eliminated.

    Raises
    ------
    NotObservable
        When the normal equations are singular.
    """
    q = len(border.gradient)
    shared, gradient, information = border.shared, border.gradient, border.information
    A, a = normal.A, normal.a
    if len(normal.C):
        C_inverse = inverse(normal.C)
        B = normal.B.reshape(-1, len(a))
        X = border.blocks.reshape(-1, q)
        by_B = (C_inverse @ normal.B).reshape(B.shape)
        by_X = (C_inverse @ border.blocks).reshape(X.shape)
        c = normal.c.ravel()
        A, a = A - B.T @ by_B, a - by_B.T @ c
        shared, gradient = shared - X.T @ by_B, gradient - by_X.T @ c
        information = information - X.T @ by_X
    back = inverse(A) @ shared.T
    information = information - shared @ back
    # Of a term that the other unknowns explain whole, rounding is left.
    lost = np.diag(information) < 1e-9 * np.diag(border.information)
    information[lost] = 0.0
    information[:, lost] = 0.0
    gradient = np.where(lost, 0.0, gradient - back.T @ a)
    return Score(gradient, 0.5 * (information + information.T))
