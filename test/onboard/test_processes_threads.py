# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""BLAS runs on one thread where starcal computes, whatever the caller has chosen for itself."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import subprocess
import sys
import threading

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from starcal_ros.processes import one_blas_thread
from studies.workers import run_each

TINY = Path(__file__).parents[2] / 'bags/tiny'


def blas_threads(_: int = 0) -> int:
    blas = [one for one in threadpool_info() if one['user_api'] == 'blas']
    return max(int(one['num_threads']) for one in blas)


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    with threadpool_limits(2, user_api='blas'):
        yield


def test_the_number_is_restored_after_an_error() -> None:
    @one_blas_thread()
    def failing() -> None:
        assert blas_threads() == 1
        raise KeyError

    with pytest.raises(KeyError):
        failing()
    assert blas_threads() == 2


def test_overlapping_blocks_of_two_threads_restore_the_number() -> None:
    """The one that began first ends first: neither ends the limit of the other, nor keeps it."""
    first_began, second_began, first_ended = (threading.Event() for _ in range(3))

    def first() -> None:
        with one_blas_thread():
            first_began.set()
            second_began.wait(60)
        first_ended.set()

    thread = threading.Thread(target=first)
    thread.start()
    first_began.wait(60)
    with one_blas_thread():
        second_began.set()
        first_ended.wait(60)
        assert blas_threads() == 1
    thread.join()
    assert blas_threads() == 2


def test_a_trial_runs_on_one_thread() -> None:
    assert run_each(blas_threads, range(2)) == [1, 1]
    assert blas_threads() == 2


LOADED_LATER = """
from starcal_ros.processes import one_blas_thread
import numpy
with one_blas_thread():
    pass
import scipy.linalg
from threadpoolctl import threadpool_info
with one_blas_thread():
    found = [one['num_threads'] for one in threadpool_info() if one['user_api'] == 'blas']
print(len(found), max(found))
"""


def test_a_library_that_is_loaded_later_has_one_thread_too() -> None:
    """NumPy and SciPy bring one each."""
    done = subprocess.run(
        [sys.executable, '-c', LOADED_LATER],
        env={**os.environ, 'OPENBLAS_NUM_THREADS': '2'},
        capture_output=True,
        text=True,
    )
    assert done.stdout.split()[1:] == ['1'], done.stdout + done.stderr


# Other threads than the one that calls spend processor time only where BLAS has given them work.
ON_ITS_THREAD = """
import sys, time
from pathlib import Path
import starcal_ros
from starcal_ros import api
from starcal_ros.pipeline import topics
from starcal_ros.pipeline.setup import read_setup
bag, params = map(Path, sys.argv[1:])
setup = read_setup(params)
records = list(topics.read([bag], topics.choose_topics([bag], topics.Topics(), setup), setup))
before = time.process_time() - time.thread_time()
found = starcal_ros.calibrate(records, setup.prior)
print(found.images_used, time.process_time() - time.thread_time() - before)
"""


@pytest.mark.slow
def test_a_calibration_from_python_takes_the_processor_time_of_one_thread() -> None:
    environment = {**os.environ, 'OPENBLAS_NUM_THREADS': '4'}
    done = subprocess.run(
        [sys.executable, '-c', ON_ITS_THREAD, TINY, TINY / 'params.yaml'],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    images, others_s = done.stdout.split()
    assert int(images) == 10 and float(others_s) < 0.2, others_s
