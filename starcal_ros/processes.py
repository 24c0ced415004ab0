# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Child processes, one BLAS thread, and an allocator that returns memory.

A child process calls functions for its parent and is reached through its own pipes only.  It does
not start from a copy of the parent, whose threads may hold locks, nor listens on a socket, where
another user could send it code.  Nothing in the current folder is imported: in the folder of an
untrusted bag a ``yaml.py`` that lies there would run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import contextlib
import ctypes
import functools
import os
import pickle
import signal
import subprocess
import sys
import threading
from typing import Any, TypeVar

Result = TypeVar('Result')

_END_S = 1.0  # a process without input ends by itself
# One process for each processor: threads that never work would take 0.1 s each to start.
_ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')
# What ``python -P -m`` does from Python 3.11 on: with -c the first entry is the current folder.
_RUN = (
    'import sys; sys.path[:] = filter(None, sys.path); import runpy; '
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


class ProcessEnded(Exception):
    """A process ended before it answered; the argument is its exit status."""


def module_command(name: str) -> list[str]:
    """Start of a command line that runs a module without the current folder among its imports."""
    return [sys.executable, '-c', _RUN, name]


class ChildProcess:
    """A process that calls one function at a time; it ends with its parent."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            module_command('starcal_ros.processes'),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
        )
        assert self._process.stdin and self._process.stdout  # both are pipes
        self._requests, self._answers = self._process.stdin, self._process.stdout
        with contextlib.suppress(BrokenPipeError):  # the first call reports the end
            pickle.dump(sys.path, self._requests)

    def call(self, function: Callable[..., Result], *args: object) -> Result:
        """Result of a function; raises its exception, or ProcessEnded if the process ended."""
        request = pickle.dumps((function, args))
        try:
            self._requests.write(request)
            self._requests.flush()
            answer: tuple[bool, Any] = pickle.load(self._answers)
        except (OSError, EOFError, ValueError, pickle.UnpicklingError) as error:
            raise ProcessEnded(self.end()) from error
        succeeded, result = answer
        if not succeeded:
            raise result
        return result  # type: ignore[no-any-return]

    def kill(self) -> None:
        """End the process at once; safe from another thread than that of a call."""
        self._process.kill()

    def end(self) -> int:
        """End the process and close its pipes; returns its exit status."""
        for pipe in (self._requests, self._answers):
            with contextlib.suppress(OSError):  # buffered output has no reader any more
                pipe.close()
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def main() -> None:
    """Answer calls from the standard input until the parent closes it, as when it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends Ctrl-C here too
    answers = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # output of a library is not part of the answer
    with contextlib.suppress(EOFError, BrokenPipeError):
        sys.path[:] = pickle.load(sys.stdin.buffer)
        while True:
            function, args = pickle.load(sys.stdin.buffer)
            try:
                answer = pickle.dumps((True, function(*args)))
            except Exception as error:
                answer = pickle.dumps((False, _portable(error)))
            answers.write(answer)
            answers.flush()


def _portable(error: Exception) -> Exception:
    """The exception, or one with its text where a pickle cannot hold it."""
    try:
        pickle.loads(pickle.dumps(error))
        return error
    except Exception:
        return RuntimeError(f'{type(error).__name__} {error}')


if __name__ == '__main__':
    main()


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
