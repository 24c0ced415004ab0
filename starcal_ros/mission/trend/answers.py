# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The answer to a task, made where the file is read: a row, or the key of the one there is."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import errno
import math
from pathlib import Path
import socket

import numpy as np

from starcal_ros.blas_threads import one_blas_thread
from starcal_ros.errors import ProductError, StarcalError
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.message_fields import OBSERVATIONS_TYPE
from starcal_ros.formats.products import calibration_json
from starcal_ros.formats.products.product_files import OBSERVATIONS_FILE
from starcal_ros.mission.trend import places
from starcal_ros.mission.trend.rows import COMPUTED, failure, RECORDED, Row, row_of
from starcal_ros.mission.trend.tasks import digest, Task
from starcal_ros.pipeline.campaign import calibrate_bags
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.pipeline.setup import load_setup, read_setup, Setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.records import Calibration, StarObservations
from starcal_ros.untrusted import json_value, METADATA_BYTES, read_text, yaml_value

_NOT_SEEN = 'not seen by this worker; mount it under the same path as on the client'
_NO_ANSWER = (errno.EIO, errno.ETIMEDOUT)  # of a store; other errors are answers


@dataclass(frozen=True)
class Answer:
    """
    The answer to a task.

    Attributes
    ----------
    key : str
        Of the row that the table has; empty where none is due.
    row : Row or None
        New row.
    calibration : str
        Content of ``calibration.json`` of a bag.
    is_silence : bool
        True if the store of the file did not answer.
    """

    key: str = ''
    row: Row | None = None
    calibration: str = ''
    is_silence: bool = False


def compute(task: Task) -> Answer:
    """Answer to a task; for one that fails, the row with its error."""
    try:
        if task.size >= 0 and not places.exists(task.url):
            raise FileNotFoundError(errno.ENOENT, _NOT_SEEN, task.url)
        # The result must not depend on the threads of BLAS.
        with places.fetched(task.url, task.files, task.size) as path, one_blas_thread():
            return _answer(task, path)
    except (OSError, ModuleNotFoundError) as error:
        return _unreachable(task, error)
    # One bag must not end a run over thousands, whatever is in it.
    except Exception as error:
        return failed(task, f'{type(error).__name__}: {error}')


def failed(task: Task, error: str, is_passing: bool = False, is_silence: bool = False) -> Answer:
    """Answer to a task that failed."""
    row = dataclasses.replace(failure(task.url, error), is_passing=is_passing)
    return Answer(row=_of_task(row, task), is_silence=is_silence)


def _unreachable(task: Task, error: OSError | ModuleNotFoundError) -> Answer:
    """The row of a file that could not be read; it passes unless the client saw that too."""
    reason = f'cannot be read: {getattr(error, "strerror", "") or error}'
    if task.size < 0:
        return failed(task, reason)
    is_silence = places.is_remote(task.url) and getattr(error, 'errno', None) in _NO_ANSWER
    return failed(task, f'{socket.gethostname()}: {reason}', True, is_silence)


def _answer(task: Task, path: Path) -> Answer:
    version = software_version() if task.is_bag else ''
    try:
        if task.is_bag and not task.params:
            beside = path.with_name(calibration_json.CALIBRATION_FILE)
            if not _is_older(beside, version):
                return Answer()
            settings: tuple[str | Path, ...] = (beside,)
        else:
            settings = task.settings
        # By content: a copy counts once, a tree may move, and what is repaired is another task.
        files = reader.files_of_bags([path]) if task.is_bag else (path,)
        key = digest((*files, *settings), version)
        if key in task.known:
            return Answer(key)
        if not task.is_bag:
            made, temperature = _recorded(path)
            return Answer(key, _of_task(row_of(made, key, task.url, RECORDED, temperature), task))
        setup = read_setup(Path(task.params)) if task.params else _setup_beside(path)
        campaign = calibrate_bags([path], setup, Topics())
        made, records = campaign.calibration, campaign.observations
        row = row_of(made, key, task.url, COMPUTED, _mean_temperature(records))
        text = calibration_json.calibration_text(made)
        return Answer(key, _of_task(row, task, path), text)
    except (StarcalError, ValueError) as error:
        cause = error.__cause__
        if isinstance(cause, OSError):
            raise cause from error
        return failed(task, str(error).replace(str(path), task.url))


def _of_task(row: Row, task: Task, bag: Path = Path()) -> Row:
    """A row with what its task and the metadata of the bag add."""
    names = _custom_data(bag / 'metadata.yaml') if task.is_bag else {}
    return dataclasses.replace(
        row,
        stamp=task.stamp,
        size_bytes=max(task.size, 0),
        spacecraft=task.spacecraft or names.get('spacecraft', ''),
        camera=task.camera or names.get('camera', ''),
    )


def _custom_data(metadata: Path) -> dict[str, str]:
    """Texts that the recorder of a bag was given; empty where there are none."""
    try:
        content = yaml_value(read_text(metadata, METADATA_BYTES))
        found = content['rosbag2_bagfile_information']['custom_data']
        return {name: value for name, value in found.items() if isinstance(value, str)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}  # rosbag2 writes it from version 0.16 on, and only where it was given


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
