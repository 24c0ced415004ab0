# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A small simulated campaign with its observations, for tests with nodes."""

from __future__ import annotations

from pathlib import Path

from bench.frames import history, render_frame, write_set_up
from starcal_ground.parameter_files import read_parameter_file
from starcal_ground.simulation import scenario
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import StarObservations


class Campaign:
    """Ten small frames, their observations, and the parameter file for nodes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scenario = scenario.scenario('tiny')
        self.params = write_set_up(self.scenario, folder)
        self.log = folder / 'log'
        self.frames = [render_frame(self.scenario, index) for index in range(10)]
        self.setup = load_setup(read_parameter_file(self.params, ()))
        self.observations: list[StarObservations] = []
        track = observe.Track(self.setup.prior)
        for image, samples in self.frames:
            found, track = observe.observe_next(image, history(samples), self.setup, track)
            self.observations.append(found)
