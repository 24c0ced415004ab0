# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Freed memory goes back to the system; for the arenas of a node see test_lifecycle."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

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
    command = [sys.executable, '-c', GAPS_IN_MEMORY]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert float(done.stdout) > 80.0  # of 100 MB; each gap loses less than two of its 24 pages
