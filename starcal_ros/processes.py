# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""One BLAS thread, and an allocator that returns memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import ctypes
import functools
import sys
import threading
from typing import Any

try:
    from threadpoolctl import ThreadpoolController
except ModuleNotFoundError:  # rosdep has no key for it: the entry points set the environment
    ThreadpoolController = None

_lock = threading.Lock()
_inside = 0  # blocks that have begun and not ended, in all threads of the process
_before: list[tuple[Any, int]] = []  # libraries, each with its number of threads outside


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """
    BLAS runs on one thread within the block, and as before after it; also a decorator.

    On matrices of this package's sizes several threads of BLAS wait for each other: a calibration
    takes up to twenty times the processor time.  The number is one of the process, so blocks of
    several threads that overlap are one: the first limits BLAS, the last restores it.
    """
    global _inside, _before
    with _lock:
        if not _inside:
            libraries = _blas(len(sys.modules))
            _before = [(library, library.get_num_threads()) for library in libraries]
            _set_threads((library, 1) for library, _ in _before)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                _set_threads(_before)


@functools.lru_cache(maxsize=1)
def _blas(_modules: int) -> list[Any]:
    """Return the libraries of BLAS; looked for again once a module has been imported."""
    if ThreadpoolController is None:
        return []
    return list(ThreadpoolController().select(user_api='blas').lib_controllers)


def _set_threads(numbers: Iterable[tuple[Any, int]]) -> None:
    for library, number in numbers:
        # From threadpoolctl 3.8 on, only the first thread to set a number can set another; here
        # the block that ends last may be in a different one.
        clear = getattr(library, 'clear_controlling_thread', lambda force: None)
        clear(force=True)
        library.set_num_threads(number)
        clear(force=True)


_M_ARENA_MAX = -8  # as in malloc.h


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
