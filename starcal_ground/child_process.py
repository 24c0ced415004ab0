# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Child processes of the tool and of ground nodes.

A child process calls functions for its parent and is reached through its own pipes only.  It does
not start from a copy of the parent, whose threads may hold locks, nor listens on a socket, where
another user could send it code.  Nothing in the current folder is imported: in the folder of an
untrusted bag a ``yaml.py`` that lies there would run.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import os
import pickle
import signal
import subprocess
import sys
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
            module_command('starcal_ground.child_process'),
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
