# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated frames and the set-up of `starcal calibrate` for them."""

from __future__ import annotations

from collections.abc import Iterable
import dataclasses
from pathlib import Path
import tempfile

import yaml

from starcal_ground.bag_writer import BagWriter
from starcal_ground.parameter_files import read_parameter_file
from starcal_ground.products import write_camera_info
from starcal_ground.simulation import rendering, simulated_bag
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats
from starcal_ros.constants import SPEED_OF_LIGHT_M_S
from starcal_ros.pipeline import observe, solve
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import AttitudeSample, Ensemble, Image
from starcal_ros.sky.astrometry import earth_velocity_c
from starcal_ros.sky.attitude import AttitudeHistory

Frame = tuple[Image, list[AttitudeSample]]


def write_set_up(scenario: Scenario, folder: Path, **values: object) -> Path:
    """Write the prior camera and parameter file of a scenario; return the path of the latter."""
    camera, params = folder / 'camera.yaml', folder / 'params.yaml'
    write_camera_info(scenario.prior.camera, camera)
    content = simulated_bag.parameters(scenario, f'file://{camera}')
    content['/**']['ros__parameters'].update(values)
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


def render_frame(scenario: Scenario, index: int) -> Frame:
    """Frame and the star-tracker samples around it."""
    image = rendering.render(scenario, synthetic.scene(scenario, index), index)
    return image, list(synthetic.attitude_samples(scenario, index))


def history(samples: list[AttitudeSample]) -> AttitudeHistory:
    """Attitude history of the samples."""
    attitudes = AttitudeHistory()
    for sample in samples:
        attitudes.add(sample.time_ns, sample)
    return attitudes


def earth_velocity_m_s(time_ns: int) -> Floats:
    """Velocity of the observer of simulated frames (3,), ICRF axes."""
    return earth_velocity_c(time_ns) * SPEED_OF_LIGHT_M_S


def observed(frames: Iterable[Frame], setup: Setup, has_velocity: bool = True) -> Ensemble:
    """Stars of frames that starcal measures in turn, given the velocity of the observer or not."""
    track, ensemble = observe.Track(setup.prior), Ensemble()
    for image, samples in frames:
        velocity_m_s = earth_velocity_m_s(image.time_ns) if has_velocity else None
        attitudes = history(samples)
        found, track = observe.observe_next(image, attitudes, setup, track, velocity_m_s)
        ensemble = solve.add_to_ensemble(ensemble, found, setup)
    return ensemble


def write_bag(frames: Iterable[Frame], path: Path) -> None:
    """Write frames with the star tracker's samples around each and the velocities then."""
    with BagWriter(path) as writer:
        for image, samples in frames:
            for sample in samples:
                time_ns, xyzw = sample.time_ns, sample.icrf_from_star_tracker_xyzw
                velocity_m_s = earth_velocity_m_s(time_ns)
                writer.write_velocity(simulated_bag.VELOCITY_TOPIC, time_ns, velocity_m_s, 'icrf')
                writer.write_attitude(simulated_bag.ATTITUDE_TOPIC, time_ns, xyzw, 'icrf')
            writer.write_image(simulated_bag.IMAGE_TOPIC, image, 'camera')
