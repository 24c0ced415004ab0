# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The images that reach a requirement which a calibration misses."""

import dataclasses

import numpy as np

from starcal_ground.planning.plan import LINE_OF_SIGHT, plan_pointings, Request
from starcal_ros.assessment.gate import FOCAL, POINTING, reasons_of, REQUIREMENTS, requirements_of
from starcal_ros.errors import StarcalError
from starcal_ros.pipeline.campaign import Campaign
from starcal_ros.records import GateCheck
from starcal_ros.text import significant

_MOST_IMAGES = 20
_LISTED = 2  # pointings in a sentence


def with_images_to_reach(campaign: Campaign) -> Campaign:
    """
    A campaign whose missed requirements have the next images in the note of their check.

    The sigma that a plan lowers is an RMS: a requirement over a share falls in proportion.
    """
    wanted = iter(requirements_of(campaign.setup.gate.requirements))
    gate = tuple(
        _planned(campaign, next(wanted).quantity, check) if check.option == REQUIREMENTS else check
        for check in campaign.calibration.gate
    )
    if gate == campaign.calibration.gate:
        return campaign
    calibration = dataclasses.replace(campaign.calibration, gate=gate, reasons=reasons_of(gate))
    return dataclasses.replace(campaign, calibration=calibration)


def _planned(campaign: Campaign, quantity: str, check: GateCheck) -> GateCheck:
    if not check.found > check.limit:
        return check
    minimise = {POINTING: LINE_OF_SIGHT, FOCAL: 'fx'}.get(quantity, quantity)
    try:
        request = Request(_MOST_IMAGES, minimise)
        plan = plan_pointings(campaign.ensemble, campaign.setup, request)
    except (StarcalError, np.linalg.LinAlgError):  # not estimated, or no image shows a star
        return check
    scale = check.found / plan.sigma
    enough = [k for k, step in enumerate(plan.steps, 1) if scale * step.sigma <= check.limit]
    if not enough:
        last = significant(scale * plan.steps[-1].sigma, 2)
        unit = check.unit and f' {check.unit}'
        words = f'{len(plan.steps)} more images reach {last}{unit}'
    else:
        count = enough[0]
        words = f'{count} more image{"s reach" if count > 1 else " reaches"} it'
        places = '; '.join(
            f'RA {place.ra_deg:.1f}, Dec {place.dec_deg:+.1f}, roll {place.roll_deg:.0f}'
            for place in (step.pointing for step in plan.steps[:count])
        )
        words += f', at {places} degrees' if count <= _LISTED else ' (starcal plan)'
    return dataclasses.replace(check, note=f'{check.note}; {words}')
