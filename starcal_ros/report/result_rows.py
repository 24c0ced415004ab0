# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the report: main results, parameters and alignment, as text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_ros.assessment.agreement import alignment_difference_rad
from starcal_ros.assessment.observability import movement_px
from starcal_ros.camera import INTRINSIC_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.number_text import significant, to_sigma
from starcal_ros.records import Calibration, CameraGeometry, TOTAL


@dataclass(frozen=True)
class Row:
    """Row of the parameter table; numbers as text, empty if absent."""

    name: str
    unit: str
    sigma: str
    change: str
    change_sigmas: str
    value: str = ''
    prior: str = ''
    moves_px: str = ''
    sigma_px: str = ''


def _none(count: int) -> str:
    return f'{count:,}' if count else 'none'


def tiles(calibration: Calibration) -> list[tuple[str, str, str]]:
    """(name, number, note) of the main results."""
    rms_px = calibration.residual_rms_px
    pixel_arcsec = 1.0 / calibration.geometry.camera.parameters[0] / ARCSECOND_RAD
    in_arcsec = f'{rms_px * pixel_arcsec:.2f}″ at {pixel_arcsec:.1f}″ per pixel'
    refused = _none(sum(calibration.images_refused.values()))
    misfits = _none(len(calibration.misfit_images_ns))
    outliers = _none(calibration.stars_rejected)
    results = [
        ('Residual', f'{rms_px:.3f} px', f'rms per axis; {in_arcsec}'),
        (
            'Images',
            f'{calibration.images_used:,}',
            f'used; {refused} refused; attitude misfits among those used: {misfits}',
        ),
        ('Stars', f'{calibration.stars_used:,}', f'used; outliers left out: {outliers}'),
    ]
    maps = calibration.maps
    if maps is not None:
        total = next((part for part in calibration.sigma_budget if part.cause == TOTAL), None)
        scopes = (
            ('Line of sight', maps.line_of_sight_sigma_arcsec,
             total.pointing_arcsec if total else None, 'in the star tracker frame'),
            ('Camera alone', maps.shape_sigma_arcsec, total.map_arcsec if total else None,
             'common rotation removed'),
        )  # fmt: skip
        for name, sigma, rms, text in scopes if calibration.has_alignment else scopes[1:]:
            worst = f'at most {significant(sigma.max(), 3)}″'
            if rms is None:
                results.append((name, worst, f'1-sigma, {text}'))
            else:
                note = f'1-sigma, rms over the detector, {text}; {worst}'
                results.append((name, f'{significant(rms, 2)}″', note))
    return results


def _minus(number: str) -> str:
    return number.replace('-', '\N{MINUS SIGN}')


def parameter_rows(calibration: Calibration, prior: CameraGeometry | None) -> list[Row]:
    """Value, sigma and change of each camera parameter."""
    camera, sigma = calibration.geometry.camera, calibration.sigma[:-3]
    if prior and prior.camera.model != camera.model:
        prior = None  # parameters of another lens model are no start of these
    changes = camera.parameters - (prior.camera.parameters if prior else camera.parameters)
    moves, sigma_moves = movement_px(camera, changes), movement_px(camera, sigma)
    rows = []
    for k, name in enumerate(camera.parameter_names):
        known, changed = sigma[k] > 0, prior and changes[k]
        held = '' if name in calibration.estimated else 'held, ' if known else 'held'
        rows.append(
            Row(
                name=name,
                unit='px' if name in INTRINSIC_NAMES else '',
                value=_minus(to_sigma(camera.parameters[k], sigma[k])),
                sigma=held + (significant(sigma[k], 2) if known else ''),
                prior=_minus(significant(prior.camera.parameters[k], 8)) if prior else '',
                change=_minus(to_sigma(changes[k], sigma[k], '+')) if changed else '',
                change_sigmas=_minus(f'{changes[k] / sigma[k]:+.1f}') if changed and known else '',
                moves_px=f'{moves[k]:.3f}' if changed else '',
                sigma_px=f'{sigma_moves[k]:.3f}' if known else '',
            )
        )
    return rows


def alignment_rows(calibration: Calibration, prior: CameraGeometry | None) -> list[Row]:
    """Change and sigma of the alignment about each axis, arcsec."""
    sigma = calibration.sigma[-3:] / ARCSECOND_RAD
    changes = (
        alignment_difference_rad(calibration.geometry, prior) / ARCSECOND_RAD
        if prior
        else np.zeros(3)
    )
    return [
        Row(
            name=axis,
            unit='arcsec',
            sigma=f'{sigma[k]:.2f}',
            change=_minus(f'{changes[k]:+.2f}') if prior else '',
            change_sigmas=_minus(f'{changes[k] / sigma[k]:+.1f}')
            if prior and sigma[k] > 0
            else '',
        )
        for k, axis in enumerate('xyz')
    ]
