# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibrations and bags under a folder tree, and the row of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import hashlib
import math
import os
from pathlib import Path
import re

import numpy as np

from starcal_ros.bag import reader
from starcal_ros.errors import ProductError, StarcalError
from starcal_ros.messages.types import OBSERVATIONS_TYPE
from starcal_ros.pipeline import solve, topics
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.pipeline.setup import files_of, load_setup, read_setup, Setup
from starcal_ros.products.calibration_json import (
    CALIBRATION_FILE,
    prior_of,
    read_calibration,
)
from starcal_ros.products.files import OBSERVATIONS_FILE
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.trend.rows import COMPUTED, failure, RECORDED, Row, row_of
from starcal_ros.untrusted import json_value, regular_file

_ARCHIVED = re.compile(r'\d{8,}_calibration_\d{8,}\.json')  # of the state folder of a calibrator


@dataclass(frozen=True)
class Task:
    """
    A calibration file to read, or a bag to calibrate; ``key`` is the digest of all that it reads.

    ``params`` is the parameter file for a bag; empty: the options and the prior in the calibration
    beside it.  ``error`` is the reason why there is no digest; empty: there is one.
    """

    key: str
    path: Path
    is_bag: bool
    params: str = ''
    error: str = ''


def find(root: Path, params: Path | None) -> Iterator[Task]:
    """
    Tasks of a folder tree, in order of their paths.

    A bag is a task where ``params`` is given, or where the calibration beside it was made by
    another version: its options and prior are used again.

    Raises
    ------
    StarcalError
        When the parameter file or a file that it names cannot be read.
    """
    version = software_version()
    settings: tuple[Path, ...] = ()
    if params is not None:
        settings = (params, *files_of(read_setup(params).frames).values())
    for path in sorted(root.rglob('*.json')):
        if path.name == CALIBRATION_FILE or _ARCHIVED.fullmatch(path.name):
            yield _task(path)
    for bag in _bags(root):
        beside = (bag if os.path.isdir(bag) else bag.parent) / CALIBRATION_FILE
        if params is not None and not os.path.exists(beside):
            yield _task(bag, version, settings, str(params))
        elif bag.name == OBSERVATIONS_FILE and _is_older(beside, version):
            yield _task(bag, version, (beside,))


def _task(path: Path, version: str = '', others: Sequence[Path] = (), params: str = '') -> Task:
    """The task of a calibration file or, with the version that would calibrate it, of a bag."""
    is_bag = bool(version)
    try:
        # By content: a copy counts once, a tree may move, and what is repaired is another task.
        files = reader.files_of_bags([path]) if is_bag else (path,)
        return Task(_digest((*files, *others), version), path, is_bag, params)
    except OSError as error:
        reason = f'cannot be read: {error.strerror}'
    except (StarcalError, ValueError) as error:
        reason = str(error)
    return Task(
        hashlib.sha256(f'{path!r} {reason}'.encode()).hexdigest(), path, is_bag, params, reason
    )


def compute(task: Task) -> Row:
    """The row of a task; of one that fails, the row with its error."""
    if task.error:
        return failed(task, task.error)
    try:
        if task.is_bag:
            return _calibrated(task)
        calibration = read_calibration(task.path)
        temperature = _temperature(task.path.with_name(OBSERVATIONS_FILE))
        return row_of(calibration, task.key, str(task.path), RECORDED, temperature)
    except StarcalError as error:
        return failed(task, str(error))
    # One bag must not end a run over thousands, whatever is in it.
    except Exception as error:
        return failed(task, f'{type(error).__name__}: {error}')


def failed(task: Task, error: str) -> Row:
    """The row of a task that failed."""
    return failure(task.key, str(task.path), error)


def _calibrated(task: Task) -> Row:
    setup = read_setup(Path(task.params)) if task.params else _setup_beside(task.path)
    chosen = topics.choose_topics([task.path], topics.Topics(), setup)
    ensemble, temperatures = Ensemble(), []
    for record in topics.read([task.path], chosen, setup):
        ensemble = solve.add_to_ensemble(ensemble, record, setup)
        temperatures.append(record.temperature_degc)
    calibration = solve.solve(ensemble, setup)
    return row_of(calibration, task.key, str(task.path), COMPUTED, _mean(temperatures))


def _setup_beside(bag: Path) -> Setup:
    """The setup of the calibration beside a bag: its options and its prior."""
    path = bag.with_name(CALIBRATION_FILE)
    calibration = read_calibration(path)
    prior = prior_of(calibration)
    try:
        options = json_value(calibration.provenance['options'])
    except (KeyError, ValueError) as error:
        raise ProductError(f'{path}: has no options to calibrate with: give --params') from error
    if prior is None:
        raise ProductError(f'{path}: has no prior to calibrate with: give --params')
    # Files that may be gone, and that observations do not need.
    files = dict.fromkeys(('dark_frame', 'flat_field', 'bad_pixel_map', 'catalog'), '')
    return load_setup({**options, **files}, prior=prior)


def _is_older(calibration: Path, version: str) -> bool:
    """True for a calibration by another version; False for none."""
    try:
        software = read_calibration(calibration).provenance.get('software', '')
    except StarcalError:
        return False  # named by its own task
    return software != f'starcal {version}'


def _bags(root: Path) -> list[Path]:
    """Bag folders with a metadata.yaml, and single files elsewhere; no files of an archive."""
    found: dict[Path, None] = {}
    for file in sorted(root.rglob('*.mcap')):
        folder = file.parent
        # One image each: the state of a calibrator, calibrated there.
        if folder.name == 'ensemble' or os.path.isdir(file):
            continue
        listed = os.path.exists(folder / 'metadata.yaml') and file.name != OBSERVATIONS_FILE
        found[folder if listed else file] = None
    return list(found)


def _digest(files: Sequence[Path], version: str) -> str:
    digest = hashlib.sha256(version.encode())
    for file in files:
        if not os.path.lexists(file):
            continue  # metadata.yaml of a bag, which need not be there
        with regular_file(file) as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _temperature(observations: Path) -> float:
    """Mean temperature of recorded observations; NaN without any."""
    if not observations.is_file():
        return math.nan
    try:
        topic = reader.choose_topic([observations], OBSERVATIONS_TYPE)
        records: list[StarObservations] = list(reader.read_observations([observations], topic))
    except StarcalError:
        return math.nan
    return _mean([record.temperature_degc for record in records if not record.refusal])


def _mean(temperatures: list[float]) -> float:
    known = [value for value in temperatures if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan
