# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrators of several processes that take the steps in the tables of tests."""

from collections.abc import Iterator
import contextlib
import dataclasses
import functools
import itertools
import math
from pathlib import Path
import shutil

from attacks import bag_setup, calibration, observations  # type: ignore[import-not-found]
from kept_state import full_disk  # type: ignore[import-not-found]
import pytest
from sample_records import without_field  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from starcal_ros.assessment.gate import judge, reasons_of
from starcal_ros.pipeline import solve as solving
from starcal_ros.pipeline.setup import CalibratorOptions, Setup
from starcal_ros.records import Calibration, Ensemble
from starcal_ros.ros.state import Answer, CalibratorState


@functools.cache
def of_a_lens_alone() -> Calibration:
    """The calibration of the bag without its field, whose tables are two thirds of its file."""
    found: Calibration = without_field(calibration())
    return found


class Calibrators:
    """Processes with a calibrator each, which share a disk and a clock; methods are steps."""

    def __init__(self, disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.disk = disk
        self._times: Iterator[int] = itertools.count(1)
        self.states: dict[str, CalibratorState] = {}
        self.is_full = contextlib.ExitStack()
        self.setup = dataclasses.replace(bag_setup(), prior=of_a_lens_alone().geometry)
        self.answer = Answer(True, '')  # to the last request
        self._candidate = of_a_lens_alone()
        self._meanwhile: tuple[str, ...] = ()
        monkeypatch.setattr(solving, 'solve', self._solve)

    def _clock(self) -> int:
        return next(self._times)

    def _solve(
        self, ensemble: Ensemble, given: Setup, active: Calibration | None = None
    ) -> Calibration:
        """Return the candidate that a row names in place of a solve of a second."""
        candidate = self._candidate
        checks = judge(candidate, given.prior, active, given.gate, given.calibration)
        reasons = reasons_of(checks)
        if self._meanwhile:
            self.run(' '.join(self._meanwhile))
        return dataclasses.replace(candidate, gate=checks, reasons=reasons, accepted=not reasons)

    def run(self, steps: str) -> CalibratorState:
        """Take steps like ``P2 images 0 1``, of P1 without a process; return the state of P1."""
        for step in steps.split('; '):
            words = step.split()
            process = words.pop(0) if words[0].startswith('P') else 'P1'
            getattr(self, words[0])(process, *words[1:])
        return self.states.setdefault('P1', CalibratorState(self._clock))

    def open(self, process: str, place: str, key: str = '') -> None:
        """Clean up and configure: with a folder, or ``-`` for memory alone, and a key file."""
        state = self.states.setdefault(process, CalibratorState(self._clock))
        state.close()
        folder = '' if place == '-' else str(self.disk / place)
        if key:
            key = str(self.disk / key)
            Path(key).write_bytes(b'sixteen bytes...')
        state.open(self.setup, CalibratorOptions(state_dir=folder, state_key_file=key))

    def close(self, process: str) -> None:
        self.states[process].close()

    def close_all(self) -> None:
        for state in self.states.values():
            state.close()

    def kill(self, process: str) -> None:
        kept = self.states.pop(process)._archive
        if kept is not None:
            kept.close()  # the system lets go of the lock

    def images(self, process: str, *which: str) -> None:
        for k in map(int, which):
            self.states[process].add(observations()[k])

    def solve(self, process: str, name: str, moved_px: str = '0', *options: str) -> None:
        """Solve to a candidate that moves the corners; ``while STEP`` comes during the solve."""
        first = of_a_lens_alone()
        camera = first.geometry.camera
        longer = 1.0 + float(moved_px) / math.hypot(camera.width / 2, camera.height / 2)
        camera = camera.replace(fx=camera.parameters[0] * longer, fy=camera.parameters[2] * longer)
        geometry = dataclasses.replace(first.geometry, camera=camera)
        self._candidate = dataclasses.replace(first, geometry=geometry, weakest_direction=name)
        k = options.index('while') if 'while' in options else len(options)
        self._meanwhile = options[k + 1 :]
        asked = options[:k]
        self.answer = self.states[process].solve(
            dry_run='dry_run' in asked, force='force' in asked
        )
        self._meanwhile = ()

    def activate(self, process: str, *words: str) -> None:
        self.solve(process, *words)
        assert self.answer.active, self.answer.message

    def reset(self, process: str) -> None:
        assert self.states[process].reset().success

    def rollback(self, process: str) -> None:
        self.answer = self.states[process].rollback()

    def limit(self, _process: str, max_change_px: str) -> None:
        """Limit the change from the active calibration; that from the prior to five times it."""
        gate = dataclasses.replace(self.setup.gate, max_change_px=float(max_change_px))
        self.setup = dataclasses.replace(self.setup, gate=gate)

    def camera(self, _process: str, frame: str, star_tracker: str = 'star_tracker') -> None:
        """Configure the camera of a frame from now on, with the same sensor."""
        self.setup = dataclasses.replace(
            self.setup,
            frames=dataclasses.replace(
                self.setup.frames, camera_frame=frame, star_tracker_frame=star_tracker
            ),
        )

    def turn(self, _process: str, degrees: str) -> None:
        prior, turn = self.setup.prior, Rotation.from_euler('z', float(degrees), degrees=True)
        mounting = (prior.star_tracker_from_camera * turn).as_quat()
        prior = dataclasses.replace(prior, star_tracker_from_camera_xyzw=mounting)
        self.setup = dataclasses.replace(self.setup, prior=prior)

    def require(self, _process: str, requirement: str) -> None:
        gate = dataclasses.replace(self.setup.gate, requirements=(requirement,))
        self.setup = dataclasses.replace(self.setup, gate=gate)

    def clock(self, _process: str, time_ns: str) -> None:
        self._times = itertools.repeat(int(time_ns))

    def full(self, _process: str) -> None:
        self.is_full.enter_context(full_disk())

    def room(self, _process: str) -> None:
        self.is_full.close()

    def copy(self, _process: str, place: str, to: str) -> None:
        shutil.copytree(self.disk / place, self.disk / to)

    def cut(self, _process: str, pattern: str) -> None:
        for path in self.disk.glob(pattern):
            path.write_bytes(path.read_bytes()[:-100])

    def touch(self, _process: str, place: str) -> None:
        (self.disk / place).touch()

    def remove(self, _process: str, place: str) -> None:
        path = self.disk / place
        path.unlink() if path.is_file() else shutil.rmtree(path)


def kept(state: CalibratorState) -> tuple[str, str]:
    """Numbers of the images, in their order, and names of the calibrations, back in time."""
    stamps = [image.time_ns for image in observations()]
    numbers = [stamps.index(image.time_ns) for image in state.ensemble.images]
    names = []
    while state.active is not None:
        names.append(state.active.weakest_direction)
        if not state.rollback().success:
            break
    return ' '.join(map(str, numbers)), ' '.join(names)


def scripts(text: str) -> dict[str, tuple[str, ...]]:
    """Cases by name, with steps and expected texts; ``none`` is an empty one, ``#`` a comment."""
    cases: dict[str, tuple[str, ...]] = {}
    name = ''
    for line in text.strip().splitlines():
        if line.startswith(' '):
            steps, *expected = cases[name]
            cases[name] = (f'{steps} {line.strip()}'.strip(), *expected)
        elif not line.startswith('#'):
            name, _, after = line.partition(' -> ')
            cases[name] = ('', *(word.replace('none', '') for word in after.split(' | ')))
    return cases
