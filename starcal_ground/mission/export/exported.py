# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The parts of a calibration that another format cannot hold, and their cost in pixels.

With its origin they are the comment of an exported file.  Names and reasons hold anything: each
comment, and each text in a format without escapes, passes `ascii_line`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project
from starcal_ros.camera.projection import convert
from starcal_ros.constants import utc_text
from starcal_ros.records import Calibration

PIXEL_CONVENTION = (
    'Pixel (u, v) = (column, row); the centre of the first pixel is (0, 0).',
    'Camera frame: +Z along the optical axis, +X along u, +Y along v.',
)
GRID = 25  # pixels a side, as in the fits of `camera`


@dataclass(frozen=True)
class Loss:
    """
    A part of a calibration that a format cannot hold.

    ``cost_px`` is the largest error of a pixel over the detector with this part alone missing and
    the other parameters fitted anew; for a change with temperature, the error per degree.
    """

    part: str
    cost_px: float


@dataclass(frozen=True)
class Content:
    """
    Files of an export: their content by name.

    ``worst_px`` is the largest error of a pixel in them against the calibration, infinite where
    the format cannot see the whole detector; ``losses`` are its parts.
    """

    files: Mapping[str, str | bytes]
    worst_px: float = 0.0
    losses: tuple[Loss, ...] = ()


def fitted(
    calibration: Calibration, model: str, zero: tuple[str, ...]
) -> tuple[CameraModel, Content]:
    """
    Best camera of a lens model without some parameters, without field and temperature terms.

    The content has its losses, and no file yet.  ``worst_px`` is infinite where the model cannot
    see the whole detector.
    """
    camera = calibration.geometry.camera
    nearest, worst_px = convert(camera, model, zero)
    losses = []
    lens = replace(camera, field=None)
    if camera.moving_field is not None:
        losses.append(Loss('field beside the lens model', _alone(camera, camera.model, ())))
    if not camera.has_lens(model):
        cost_px = _alone(lens, model, ())
        if cost_px > 0:
            losses.append(Loss(f'lens model {camera.model} (here {model})', cost_px))
        lens, _ = convert(lens, model, ())
    losses += [
        Loss(name, _alone(lens, model, (name,)))
        for name in zero
        if lens.parameters[lens.parameter_names.index(name)] != 0
    ]
    return nearest, Content({}, worst_px, (*losses, *temperature_losses(calibration)))


def _alone(camera: CameraModel, model: str, zero: tuple[str, ...]) -> float:
    return convert(camera, model, zero)[1]


def temperature_losses(calibration: Calibration) -> tuple[Loss, ...]:
    """Changes with temperature, as errors per degree Celsius."""
    terms = calibration.temperature
    if terms is None:
        return ()
    lens = replace(calibration.geometry.camera, field=None)
    pixels = pixel_grid(lens, GRID, GRID)
    losses = []
    if terms.focal_per_degc:
        from_axis = pixels - lens.intrinsics[3:5]
        cost = float(np.linalg.norm(terms.focal_per_degc[0] * from_axis, axis=1).max())
        losses.append(Loss('change of the focal length per degC', cost))
    if terms.alignment_rate_rad_per_degc:
        rate = np.array(terms.alignment_rate_rad_per_degc)
        directions = line_of_sight(lens, pixels)
        # A passive small rotation takes directions to d - rate x d.
        moved = directions - np.cross(rate, directions)
        cost = float(np.nanmax(np.linalg.norm(project(lens, moved) - pixels, axis=1)))
        losses.append(Loss('change of the alignment per degC', cost))
    return tuple(losses)


def origin(calibration: Calibration) -> list[str]:
    """Lines that name software, images, verdict and sources of a calibration."""
    verdict = 'passed' if calibration.accepted else 'failed: ' + '; '.join(calibration.reasons)
    lines = [
        f'Calibration by {calibration.provenance.get("software", "starcal")}',
        f'From {utc_text(calibration.first_image_ns)} to {utc_text(calibration.time_ns)}',
        f'Images: {calibration.images_used}; stars: {calibration.stars_used}',
        f'Residual: {calibration.residual_rms_px:.4f} px rms per axis; gate: {verdict}',
    ]
    for name, value in sorted(calibration.provenance.items()):
        if name not in ('software', 'options', 'prior'):
            lines.append(f'{name}: {value}')
    return lines


def ascii_line(text: str) -> str:
    """Text in one line of printable ASCII: a control character makes YAML and kernels invalid."""
    return ''.join(c if ' ' <= c <= '~' else ' ' if c.isspace() else '?' for c in text)


def about(calibration: Calibration, made: Content) -> list[str]:
    """Lines of a comment: origin, error of the exported camera, and that of each missing part."""
    lines = [f'Largest error of a pixel against the calibration: {made.worst_px:.3g} px.']
    if made.losses:
        lines.append('Left out, with the error that each alone would cause:')
        lines += [f'  {loss.part}: {loss.cost_px:.3g} px' for loss in made.losses]
    else:
        lines.append('Nothing is left out.')
    return [*origin(calibration), *lines, *PIXEL_CONVENTION]
