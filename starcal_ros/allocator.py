# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The allocator of glibc in a node that runs for months; elsewhere these functions do nothing."""

from __future__ import annotations

import ctypes
from typing import Any

_M_ARENA_MAX = -8  # of malloc.h


def use_one_arena() -> None:
    """
    Have the allocator serve all threads from one arena; before the first thread.

    By default each thread of an executor keeps the memory that it has freed: a calibrator that
    solved in turn on eight threads grew to twice its size.
    """
    mallopt = _function('mallopt')
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


def return_freed_memory() -> None:
    """
    Have the allocator return free pages to the system, which it keeps between others.

    Large images of several threads leave gaps: in ten minutes a star observer grew by a quarter.
    A fixed threshold for memory maps prevents them too, for half as much processor time again.
    """
    trim = _function('malloc_trim')
    if trim is not None:
        trim(0)


def _function(name: str) -> Any:
    return getattr(ctypes.CDLL(None), name, None)  # musl has neither
