# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A small simulated campaign with its observations and calibration, for benches with nodes."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from bench import graph
from bench.frames import history, render_frame, write_set_up
from starcal_ros.messages.fields import make_header
from starcal_ros.messages.observations import observations_to_message
from starcal_ros.options import read_parameter_file
from starcal_ros.pipeline import observe, solve
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.simulation import scenario


class Campaign:
    """Ten small frames, their observations and calibration, and the parameter file for nodes."""

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
        ensemble = functools.reduce(Ensemble.add, self.observations, Ensemble())
        self.calibration = solve.solve(ensemble, self.setup)

    def message(self, record: StarObservations, time_ns: int | None = None) -> Any:
        """Observations as a message, optionally with another stamp."""
        from starcal_ros.nodes.lifecycle_node.message_factory import make_message

        message = observations_to_message(record, 'camera', make_message)
        if time_ns is not None:
            message.header = make_header(time_ns, 'camera', make_message)
        return message

    def running(self, name: str, *values: str, **options: Any) -> Any:
        """Context manager of a node process."""
        return graph.running(name, self.params, self.log, *values, **options)
