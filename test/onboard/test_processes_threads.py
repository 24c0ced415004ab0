# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""BLAS runs on one thread where starcal computes, whatever the caller has chosen for itself."""

from __future__ import annotations

from collections.abc import Iterator
import os
import subprocess
import sys
import threading
from types import FrameType

import attacks  # type: ignore[import-not-found]
import pytest
from threadpoolctl import threadpool_info, threadpool_limits, ThreadpoolController

import starcal_ground
from starcal_ros.processes import one_blas_thread
from studies.workers import run_each


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
            second_began.wait(240)
        first_ended.set()

    thread = threading.Thread(target=first)
    thread.start()
    first_began.wait(240)
    with one_blas_thread():
        second_began.set()
        first_ended.wait(240)
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


def test_the_estimate_of_a_calibration_from_python_is_on_one_thread() -> None:
    libraries = ThreadpoolController().select(user_api='blas').lib_controllers
    numbers: set[int] = set()

    def look(frame: FrameType, event: str, _: object) -> None:
        if event == 'call' and '/linalg/' in frame.f_code.co_filename and frame.f_back:
            room = os.path.dirname(frame.f_back.f_code.co_filename)
            numbers.update(
                library.get_num_threads()
                for library in libraries
                if room.endswith(('estimation', 'assessment'))
            )

    records, prior = attacks.observations(), attacks.setup().prior
    sys.setprofile(look)
    try:
        calibration = starcal_ground.calibrate(records, prior)
    finally:
        sys.setprofile(None)
    assert (calibration.images_used, numbers) == (10, {1})
