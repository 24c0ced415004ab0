# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibrations and bags under a folder tree, and the row of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import hashlib
import math
from pathlib import Path
import re

import numpy as np

from starcal_ros.bag import reader
from starcal_ros.errors import ProductError, StarcalError
from starcal_ros.messages.types import OBSERVATIONS_TYPE
from starcal_ros.pipeline import solve, topics
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.pipeline.setup import load_setup, read_setup, Setup
from starcal_ros.products.calibration_json import (
    CALIBRATION_FILE,
    prior_of,
    read_calibration,
)
from starcal_ros.products.files import OBSERVATIONS_FILE, read_text
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.trend.rows import COMPUTED, FAILED, RECORDED, Row, row_of
from starcal_ros.untrusted import json_value, PARAMETER_BYTES

_ARCHIVED = re.compile(r'\d{8,}_calibration_\d{8,}\.json')  # of the state folder of a calibrator


@dataclass(frozen=True)
class Task:
    """
    A calibration file to read, or a bag to calibrate; ``key`` is the digest of both and settings.

    ``params`` is the parameter file for a bag; empty: the options and the prior in the calibration
    beside it.
    """

    key: str
    path: Path
    is_bag: bool
    params: str = ''


def find(root: Path, params: Path | None) -> Iterator[Task]:
    """
    Tasks of a folder tree, in order of their paths.

    A bag is a task where ``params`` is given, or where the calibration beside it was made by
    another version: its options and prior are used again.
    """
    # By content: a copy counts once, and a tree may move.
    version = software_version()
    settings = ''
    if params is not None:
        settings = hashlib.sha256(read_text(params, PARAMETER_BYTES).encode()).hexdigest()
    for path in sorted(root.rglob('*.json')):
        if not path.is_file():
            continue
        if path.name == CALIBRATION_FILE or _ARCHIVED.fullmatch(path.name):
            yield Task(_digest(path, ''), path, is_bag=False)
    for bag in _bags(root):
        beside = (bag if bag.is_dir() else bag.parent) / CALIBRATION_FILE
        if params is not None and not beside.exists():
            yield Task(_digest(bag, version + settings), bag, True, str(params))
        elif beside.exists() and bag.name == OBSERVATIONS_FILE and _is_older(beside, version):
            yield Task(_digest(bag, version), bag, True)


def compute(task: Task) -> Row:
    """The row of a task; of one that fails, the row with its error."""
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
    return Row(task.key, str(task.path), FAILED, error=' '.join(error.split()) or 'failed')


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
        if folder.name == 'ensemble' or not file.is_file():
            continue
        listed = (folder / 'metadata.yaml').exists() and file.name != OBSERVATIONS_FILE
        found[folder if listed else file] = None
    return list(found)


def _digest(path: Path, settings: str) -> str:
    digest = hashlib.sha256(settings.encode())
    files = sorted(path.glob('*.mcap')) if path.is_dir() else [path]
    for file in files:
        with file.open('rb') as stream:
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
