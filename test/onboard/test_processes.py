# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""One BLAS thread where starcal computes, and freed memory returned to the system."""

from collections.abc import Iterator
import ctypes
import os
import sys
import threading
from types import FrameType

import attacks  # type: ignore[import-not-found]
import pytest
from starcal_tool import run_python  # type: ignore[import-not-found]
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
    done = run_python('-c', LOADED_LATER, env={**os.environ, 'OPENBLAS_NUM_THREADS': '2'})
    assert done.stdout.split()[1:] == ['1'], done.stdout + done.stderr


def test_the_estimate_of_a_calibration_from_python_is_on_one_thread() -> None:
    libraries = ThreadpoolController().select(user_api='blas').lib_controllers
    numbers: set[int] = set()

    def look(frame: FrameType, event: str, _: object) -> None:
        if event == 'call' and '/linalg/' in frame.f_code.co_filename and frame.f_back:
            room = os.path.dirname(frame.f_back.f_code.co_filename)
            if room.endswith(('estimation', 'assessment')):
                numbers.update(library.get_num_threads() for library in libraries)

    records, prior = attacks.observations()[:4], attacks.bag_setup().prior
    sys.setprofile(look)
    try:
        calibration = starcal_ground.calibrate(records, prior)
    finally:
        sys.setprofile(None)
    assert (calibration.images_used, numbers) == (4, {1})


GAPS_IN_MEMORY = """
import ctypes
from starcal_ros.processes import return_freed_memory
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
libc.memset.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]

def resident_mb():
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * 4096e-6

large = []
for _ in range(1000):  # each below the threshold of memory maps, and pinned by a small one
    large.append(libc.malloc(100_000))
    libc.memset(large[-1], 1, 100_000)
    libc.malloc(3000)
for one in large:
    libc.free(one)
before_mb = resident_mb()
return_freed_memory()
print(before_mb - resident_mb())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), 'malloc_trim'), reason='glibc alone has it')
def test_freed_memory_between_other_returns_to_the_system() -> None:
    done = run_python('-c', GAPS_IN_MEMORY)
    assert (done.returncode, done.stderr) == (0, '')
    assert float(done.stdout) > 80.0  # of 100 MB; each gap loses less than two of its 24 pages
