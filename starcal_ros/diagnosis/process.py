# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A diagnosis in a process of its own, of the lowest priority: no image of a node waits for it."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import pickle
import subprocess
import sys
import threading

from starcal_ros.diagnosis.attitude_reading import SetUp, WireAttitudes
from starcal_ros.diagnosis.diagnose import diagnose, Diagnosis
from starcal_ros.records import Image
from starcal_ros.safe_path import module_command
from starcal_ros.sky.catalog import load_catalog

_LOWEST_PRIORITY = 19


@dataclass(frozen=True)
class Question:
    """What `diagnose` is asked; ``catalog`` is a path, empty for the bundled one."""

    images: tuple[Image, ...]
    attitudes: WireAttitudes
    setup: SetUp
    catalog: str
    magnitude_limit: float


class DiagnosisProcess:
    """Answers one question at a time; `stop` ends it from another thread."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._stopped = False

    def ask(self, question: Question) -> Diagnosis | None:
        """The diagnosis of some images; None where the process was stopped or failed."""
        package = str(Path(__file__).parents[2])
        paths = [package, *filter(None, [os.environ.get('PYTHONPATH', '')])]
        environment = {
            **os.environ,
            'PYTHONPATH': os.pathsep.join(paths),
            'OPENBLAS_NUM_THREADS': '1',
        }
        with self._lock:
            if self._stopped:
                return None
            process = self._process = subprocess.Popen(
                module_command('starcal_ros.diagnosis.process'),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment,
                start_new_session=True,  # a signal from the terminal is for the node
            )
        written, _ = process.communicate(pickle.dumps(question))
        if process.returncode != 0:
            return None
        found = pickle.loads(written)
        return found if isinstance(found, Diagnosis) else None

    def stop(self) -> None:
        """End the process; later questions have no answer."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.kill()


def answer() -> None:
    """Read a question from the standard input and write its diagnosis to the standard output."""
    os.nice(_LOWEST_PRIORITY)
    question: Question = pickle.load(sys.stdin.buffer)
    path = Path(question.catalog) if question.catalog else None
    catalog = load_catalog(path, question.magnitude_limit)
    found = diagnose(question.images, question.attitudes, question.setup, catalog)
    sys.stdout.buffer.write(pickle.dumps(found))


if __name__ == '__main__':
    answer()
