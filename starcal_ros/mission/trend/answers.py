# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The answer to a task, made where the file is read: a row, or that there is one already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import hashlib
import math
import os
from pathlib import Path
import posixpath
import socket

import numpy as np

from starcal_ros.errors import ProductError, StarcalError
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.message_fields import OBSERVATIONS_TYPE
from starcal_ros.formats.products import calibration_json
from starcal_ros.formats.products.product_files import OBSERVATIONS_FILE, REPORT_FILE
from starcal_ros.mission.trend import places
from starcal_ros.mission.trend.rows import (
    COMPUTED,
    failure,
    kept_name,
    RECORDED,
    Row,
    row_of,
    START,
)
from starcal_ros.mission.trend.tasks import digest, KEPT_FOLDER, Task
from starcal_ros.pipeline.campaign import calibrate_bags
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.pipeline.setup import load_setup, read_setup, Setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.records import Calibration, StarObservations
from starcal_ros.untrusted import json_value, METADATA_BYTES, read_text, yaml_value

_NOT_SEEN = 'not seen by this worker; mount it under the same path as on the client'


@dataclass(frozen=True)
class Seen:
    """Nothing new: the start of the key of the row there is, or empty where none is due."""

    key: str = ''


def compute(task: Task) -> Row | Seen:
    """The row of a task, or `Seen`; of one that fails, the row with its error."""
    try:
        if task.size >= 0 and not places.exists(task.url):
            raise FileNotFoundError(2, _NOT_SEEN, task.url)
        with places.fetched(task.url, task.files) as path:
            return _answer(task, path)
    except OSError as error:
        return _unreachable(task, error)
    # One bag must not end a run over thousands, whatever is in it.
    except Exception as error:
        return failed(task, f'{type(error).__name__}: {error}')


def failed(task: Task, error: str, key: str = '', is_passing: bool = False) -> Row:
    """The row of a task that failed."""
    key = key or hashlib.sha256(f'{task.url!r} {error}'.encode()).hexdigest()
    return _of_task(failure(key, task.url, error), task, is_passing=is_passing)


def _unreachable(task: Task, error: OSError) -> Row:
    """The row of a file that could not be read; it passes unless the client saw that too."""
    reason = f'cannot be read: {error.strerror or error}'
    if task.size < 0:
        return failed(task, reason)
    return failed(task, f'{socket.gethostname()}: {reason}', is_passing=True)


def _answer(task: Task, path: Path) -> Row | Seen:
    version, key = software_version() if task.is_bag else '', ''
    try:
        if task.is_bag and not task.params:
            beside = path.with_name(calibration_json.CALIBRATION_FILE)
            if not _is_older(beside, version):
                return Seen()
            settings: tuple[str | Path, ...] = (beside,)
        else:
            settings = task.settings
        # By content: a copy counts once, a tree may move, and what is repaired is another task.
        files = reader.files_of_bags([path]) if task.is_bag else (path,)
        key = digest((*files, *settings), version)
        if key[:START] in task.known:
            return Seen(key[:START])
        if not task.is_bag:
            made, temperature = _recorded(path)
            return _of_task(row_of(made, key, task.url, RECORDED, temperature), task)
        setup = read_setup(Path(task.params)) if task.params else _setup_beside(path)
        campaign = calibrate_bags([path], setup, Topics())
        made, records = campaign.calibration, campaign.observations
        row = row_of(made, key, task.url, COMPUTED, _mean_temperature(records))
        row = _of_task(row, task, path)
        products = {calibration_json.CALIBRATION_FILE: calibration_json.calibration_text(made)}
        if task.with_report:
            from starcal_ros.report import page  # seldom needed, slow to load

            # Pictures of images would be most of its bytes.
            contents = page.Found(made, campaign.residuals, records, (), ())
            products[REPORT_FILE] = page.render(contents, Path(task.url))
        return _kept(row, products, task) if task.table else row
    except (StarcalError, ValueError) as error:
        cause = error.__cause__
        if isinstance(cause, OSError):
            raise cause from error
        return failed(task, str(error).replace(str(path), task.url), key)


def _of_task(row: Row, task: Task, bag: Path = Path(), is_passing: bool = False) -> Row:
    """A row with what its task and the metadata of the bag add."""
    names = _custom_data(bag / 'metadata.yaml') if task.is_bag else {}
    return dataclasses.replace(
        row,
        stamp=task.stamp,
        size_bytes=max(task.size, 0),
        spacecraft=task.spacecraft or names.get('spacecraft', ''),
        camera=task.camera or names.get('camera', ''),
        is_passing=is_passing,
    )


def _custom_data(metadata: Path) -> dict[str, str]:
    """Texts that the recorder of a bag was given; empty where there are none."""
    try:
        content = yaml_value(read_text(metadata, METADATA_BYTES))
        found = content['rosbag2_bagfile_information']['custom_data']
        return {name: value for name, value in found.items() if isinstance(value, str)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}  # rosbag2 writes it from version 0.16 on, and only where it was given


def _kept(row: Row, products: Mapping[str, str], task: Task) -> Row:
    """The row after the products are written; a failure that passes if they cannot be."""
    try:
        # A worker of a cluster would make a folder of its own, in which nobody looks.
        if not places.is_remote(task.table) and not os.path.isdir(task.table):
            raise FileNotFoundError(2, _NOT_SEEN)
        folder = places.join(posixpath.dirname(task.table), KEPT_FOLDER)
        for name, text in products.items():
            places.write(places.join(folder, f'{kept_name(row)}/{name}'), text.encode())
    except (OSError, ProductError) as error:
        reason = f'{task.table}: cannot be written: {getattr(error, "strerror", "") or error}'
        return failed(task, f'{socket.gethostname()}: {reason}', is_passing=True)
    return row


def _recorded(path: Path) -> tuple[Calibration, float]:
    """A recorded calibration and its mean temperature."""
    temperature = _temperature(path.with_name(OBSERVATIONS_FILE))
    return calibration_json.read_calibration(path), temperature


def _setup_beside(bag: Path) -> Setup:
    """The setup of the calibration beside a bag: its options and its prior."""
    path = bag.with_name(calibration_json.CALIBRATION_FILE)
    calibration = calibration_json.read_calibration(path)
    prior = calibration_json.prior_of(calibration)
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
        software = calibration_json.read_calibration(calibration).provenance.get('software', '')
    except StarcalError:
        return False  # named by its own task
    return software != f'starcal {version}'


def _temperature(observations: Path) -> float:
    """Mean temperature of recorded observations; NaN without any."""
    if not observations.is_file():
        return math.nan
    try:
        topic = reader.choose_topic([observations], OBSERVATIONS_TYPE)
        records: list[StarObservations] = list(reader.read_observations([observations], topic))
    except StarcalError:
        return math.nan
    return _mean_temperature([record for record in records if not record.refusal])


def _mean_temperature(records: Sequence[StarObservations]) -> float:
    degc = np.array([record.temperature_degc for record in records])
    known = degc[~np.isnan(degc)]
    return float(np.mean(known)) if len(known) else math.nan
