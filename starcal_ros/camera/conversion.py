# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The camera of another lens model, or without some parameters, nearest to a given camera."""

from __future__ import annotations

import dataclasses

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import (
    CameraModel,
    line_of_sight,
    parameter_names,
    pixel_grid,
    project,
    project_jacobians,
)
from starcal_ros.camera.lens import COEFFICIENTS

# Penalty of a fit for each unit by which a coefficient of a rational polynomial changes.
_HELD_PX = 1e-2


def ros_fit(camera: CameraModel) -> tuple[CameraModel, float]:
    """
    Best camera without skew and field, for readers of ``camera_info``, and its worst error, px.

    ROS consumers ignore K[0,1], but their OpenCV has every lens model here.  Skew is a shear; half
    of it is a rotation that only the alignment could carry, so some error stays.
    """
    return nearest_camera(camera, camera.model, ('skew',))


def convert(camera: CameraModel, model: str) -> tuple[CameraModel, float]:
    """
    Best camera of a lens model for the lines of sight of another camera, and its worst error.

    Least squares over a 25 x 25 grid of the detector, starting with the coefficients that both
    models have.  Raises ValueError for an unknown model.

    Returns
    -------
    camera : CameraModel
    worst_px : float
        Largest pixel error over the grid; infinite where the model cannot see all of it.
    """
    if model == camera.model and not camera.has_field:
        return dataclasses.replace(camera, field=None), 0.0
    if model not in COEFFICIENTS:
        raise ValueError(f'lens model: {model!r} is not one of {", ".join(COEFFICIENTS)}')
    names = parameter_names(model)
    known = dict(zip(camera.parameter_names, camera.parameters, strict=True))
    same_plane = 'equidistant' not in (model, camera.model)
    start = np.array([known.get(name, 0.0) for name in names])
    if not same_plane:
        start[5:] = 0.0
    started = CameraModel(camera.width, camera.height, start, model)
    if same_plane and known.keys() <= set(names) and not camera.has_field:
        return started, 0.0  # a special case of the larger model
    return _fit(started, list(range(len(names))), camera)


def nearest_camera(
    camera: CameraModel, model: str, zero: tuple[str, ...]
) -> tuple[CameraModel, float]:
    """
    As `convert`, without field and with some parameters held at zero, for formats without them.

    Raises ValueError for an unknown model, or a name that is not one of its parameters.
    """
    start = camera if model == camera.model else convert(camera, model)[0]
    start = dataclasses.replace(start.replace(**dict.fromkeys(zero, 0.0)), field=None)
    unchanged = not camera.has_field and model == camera.model
    if unchanged and np.array_equal(start.parameters, camera.parameters):
        return start, 0.0
    free = [k for k, name in enumerate(start.parameter_names) if name not in zero]
    return _fit(start, free, camera)


def _fit(start: CameraModel, free: list[int], camera: CameraModel) -> tuple[CameraModel, float]:
    """Camera fitted to the pixels of the lines of sight of another, and its worst error, px."""
    target = pixel_grid(camera, 25, 25)
    directions = line_of_sight(camera, target)
    exists = np.isfinite(directions[:, 0])
    target, directions = target[exists], directions[exists]
    seen = np.isfinite(project(start, directions)).all(axis=1)

    def moved(x: Floats) -> CameraModel:
        parameters = start.parameters.copy()
        parameters[free] = x
        return dataclasses.replace(start, parameters=parameters)

    # Numerator and denominator of a rational polynomial can grow together: without a penalty
    # the coefficients reach 10^4 for a gain of 1e-3 px.
    held_px = np.diag(np.where(np.arange(len(start.parameters)) < 5, 0.0, _HELD_PX))[free][:, free]
    if start.model in ('plumb_bob', 'equidistant'):
        held_px = held_px[:0]

    def residual(x: Floats) -> Floats:
        off = project(moved(x), directions[seen]) - target[seen]
        return np.concatenate([off.ravel(), held_px @ (x - start.parameters[free])])

    def jacobian(x: Floats) -> Floats:
        J = project_jacobians(moved(x), directions[seen])[1]
        return np.concatenate([J[..., free].reshape(-1, len(free)), held_px])

    # MINPACK scales the parameters by their columns and bounds the step.
    from scipy.optimize import least_squares  # a third of the start of a short command

    found = least_squares(
        residual,
        start.parameters[free],
        jacobian,
        method='lm',
        x_scale='jac',
        ftol=1e-9 if len(held_px) else 1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=200,
    )
    fitted = moved(found.x)
    error = np.linalg.norm(project(fitted, directions) - target, axis=-1)
    return fitted, float(np.where(np.isnan(error), np.inf, error).max(initial=0.0))
