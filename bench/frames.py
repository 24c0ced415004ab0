# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated frames and the set-up of `starcal calibrate` for them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import tempfile

import yaml

from starcal_ros.formats.products.camera_yaml import write_camera_info
from starcal_ros.options import read_parameter_file
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import AttitudeSample, Image
from starcal_ros.sky.attitude import AttitudeHistory
from starcal_ros.studies.simulation import rendering, simulated_bag
from starcal_ros.studies.simulation import scenario as synthetic
from starcal_ros.studies.simulation.scenario import Scenario


def write_set_up(scenario: Scenario, folder: Path, **values: object) -> Path:
    """Write the prior camera and parameter file of a scenario; return the path of the latter."""
    camera, params = folder / 'camera.yaml', folder / 'params.yaml'
    write_camera_info(scenario.prior.camera, camera)
    content = simulated_bag.parameters(scenario, f'file://{camera}')
    content['/**']['ros__parameters'].update(values)  # type: ignore[index]
    params.write_text(yaml.safe_dump(content))
    return params


def load_set_up(scenario: Scenario, **values: object) -> Setup:
    """The options of a scenario with its prior camera and catalog loaded."""
    with tempfile.TemporaryDirectory() as folder:
        params = write_set_up(scenario, Path(folder), **values)
        return load_setup(read_parameter_file(params, ()))


def paper_scenario(magnitude_limit: float) -> Scenario:
    """Scenario with frames of 2592 x 2048 and stars down to a magnitude."""
    return dataclasses.replace(synthetic.scenario('paper'), magnitude_limit=magnitude_limit)


def render_frame(scenario: Scenario, index: int) -> tuple[Image, list[AttitudeSample]]:
    """Frame and the star-tracker samples around it."""
    image = rendering.render(scenario, synthetic.scene(scenario, index), index)
    return image, list(synthetic.attitude_samples(scenario, index))


def history(samples: list[AttitudeSample]) -> AttitudeHistory:
    """Attitude history of the samples."""
    attitudes = AttitudeHistory()
    for sample in samples:
        attitudes.add(sample.time_ns, sample)
    return attitudes
