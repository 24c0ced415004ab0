# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Activated calibrations on record, and the present gate on a stored one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_ros.assessment.gate import judge, reasons_of
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Calibration


@dataclass(frozen=True)
class Activation:
    """
    A calibration was activated, for the first time or by a roll-back.

    ``event`` counts activations; ``before`` is the event that a roll-back of this one returns to,
    0 for none.  The calibration is active until the next event.
    """

    event: int
    before: int
    calibration: Calibration


def refusals_today(calibration: Calibration, setup: Setup) -> tuple[str, ...]:
    """
    Reasons why a stored calibration must not become active, a sentence each; empty if it may.

    The gate judges it with the prior and the limits of the setup, as if none were active.  One
    that was activated despite the gate may fail the checks that it failed then, and no others:
    the request overrode those.
    """
    camera, prior = calibration.geometry.camera, setup.prior.camera
    if (camera.width, camera.height) != (prior.width, prior.height):
        size = f'it is of a camera of {camera.width} x {camera.height}'
        return (f'{size}, the prior camera has {prior.width} x {prior.height}',)
    if not (calibration.accepted or calibration.forced):
        return ('its file states that the gate refused it', *calibration.reasons)
    try:
        with np.errstate(all='ignore'):
            checks = judge(calibration, setup.prior, None, setup.gate, setup.calibration)
    # A file can hold numbers that no solution has, and that an equation cannot take.
    except Exception as error:
        return (f'the gate cannot judge it: {type(error).__name__}: {error}',)
    overridden = set()
    if calibration.forced:
        overridden = {check.name for check in calibration.gate if check.passed is False}
    return reasons_of(check for check in checks if check.name not in overridden)
