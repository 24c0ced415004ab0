# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Judgement of a stored calibration before it is active: its numbers and the gate of today."""

from __future__ import annotations

import numpy as np

from starcal_ros.bag.typestore import make_message, typestore
from starcal_ros.gate.judgement import judge, reasons_of
from starcal_ros.messages.calibration import (
    alignment_to_message,
    calibration_to_message,
    camera_info_to_message,
)
from starcal_ros.messages.types import ALIGNMENT_TYPE, CALIBRATION_TYPE, CAMERA_INFO_TYPE
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Calibration


def check_publishable(calibration: Calibration) -> None:
    """
    Check that the messages of a calibration can hold its values.

    Raises
    ------
    ValueError
        Naming the message.
    """
    for kind, make in (
        (CALIBRATION_TYPE, calibration_to_message),
        (CAMERA_INFO_TYPE, camera_info_to_message),
        (ALIGNMENT_TYPE, alignment_to_message),
    ):
        try:
            with np.errstate(all='ignore'):
                typestore().serialize_cdr(make(calibration, make_message), kind)
        # The exceptions of a value that its field cannot hold have no common base class.
        except Exception as error:
            raise ValueError(f'not to be held by a {kind}: {error}') from error


def refusals_today(calibration: Calibration, setup: Setup) -> tuple[str, ...]:
    """
    Why a stored calibration must not become active, a sentence each; empty where it may.

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
