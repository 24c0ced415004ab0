# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tasks that kill the process that they run in; worker processes import them from here."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import signal

from starcal_ros.trend import tasks
from starcal_ros.trend.rows import Row
from starcal_ros.trend.tasks import Task


def kill_on_poison(task: Task) -> Row:
    """Row of a task; a poisonous one kills the process that it runs in."""
    if task.path.name == 'poison':
        os.kill(os.getpid(), signal.SIGKILL)
    return tasks.compute(task)


def kill_once(task: Task) -> Row:
    """Row of a task; the first to find the marker kills its process."""
    marker = Path(task.params)
    try:
        marker.unlink()
    except FileNotFoundError:
        return tasks.compute(dataclasses.replace(task, params=''))
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError
