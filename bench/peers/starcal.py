# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""starcal: the command from a bag to the products, and its estimator with all checks alone."""

from __future__ import annotations

from pathlib import Path
import tempfile

from bench.calibrate import cost, TOOL
from bench.frames import observed, write_bag, write_set_up
from bench.peers.campaigns import Campaign, Result
from bench.table import timed
from starcal_ground.images.from_stars import from_stars, ideal_camera
from starcal_ros import read_calibration
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.pipeline.solve import solve
from starcal_ros.records import Calibration
from studies.trials import rms


def whole(campaign: Campaign) -> list[Result]:
    """``starcal calibrate`` as a process; its time includes imports and the report."""
    with tempfile.TemporaryDirectory() as name:
        bag, out = Path(name, 'bag'), Path(name, 'out')
        write_bag(campaign.frames, bag)
        params = write_set_up(campaign.scenario, Path(name))
        spent = cost(['-c', TOOL, 'calibrate', f'{bag}', '--params', f'{params}', '-o', f'{out}'])
        return [_result(campaign, read_calibration(out), spent.processor_s)]


def estimator(campaign: Campaign) -> list[Result]:
    """From stars to a judged calibration."""
    return [_result(campaign, *timed(lambda: solve(campaign.ensemble, campaign.setup)))]


def _result(campaign: Campaign, found: Calibration, processor_s: float) -> Result:
    table = line_of_sight_table(found.geometry.camera, found.map_covariance, campaign.pixels)
    verdict = 'accepted' if found.accepted else 'refused by its gate'
    used = (found.images_used, found.stars_used)
    return Result(
        verdict, table.direction_camera, *used, processor_s, rms(table.shape_sigma_arcsec)
    )


def tracked(campaign: Campaign) -> tuple[int, int]:
    """Number of frames found with attitudes, and of stars measured."""
    found = observed(campaign.frames, campaign.setup).images
    return len(found), sum(map(len, found))


def identified(campaign: Campaign) -> tuple[int, int]:
    """Number of frames found by the patterns of their stars, and 0: none is measured."""
    camera = campaign.scenario.truth.camera
    hint = ideal_camera((camera.width, camera.height), float(camera.parameters[0]))
    found = from_stars([image for image, _ in campaign.frames], campaign.setup.catalog, [hint])
    return len(found.icrf_from_camera), 0
