# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calls of readers in a child process with limits of memory and time.

A file of a few megabytes can inflate to gigabytes, keep a library busy for minutes, name a pipe
that nobody writes to, or crash compiled code.  No reader can exclude all of that for its format:
here it ends the child process, and costs the file one line.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import os
import pickle
import resource
import signal
import subprocess
import sys
from typing import Any, IO, TYPE_CHECKING, TypeVar

from starcal_ros.errors import StarcalError
from starcal_ros.ingest.records import IngestError
from starcal_ros.safe_path import module_command

if TYPE_CHECKING:
    from typing_extensions import Self

Result = TypeVar('Result')

_ADDRESS_SPACE = 9 << 27  # bytes; Python and the libraries take 0.5 GB, of which 0.1 are in memory
_NO_MEMORY = 77  # exit status


class Guard:
    """
    One child process that calls functions for its parent; it is started again after its end.

    Use it in a ``with`` statement.

    Parameters
    ----------
    processor_s : float
        Limit of a call; 10^6 attitudes in a table take 6 s on a processor of 3 GHz.
    wall_s : float
        Limit of a call that waits; longer, since other processes may share the processor.
    """

    def __init__(self, processor_s: float = 10.0, wall_s: float = 30.0) -> None:
        self._limits_s = (processor_s, wall_s)
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        """Return the guard; its process starts with the first call."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._end()

    def call(self, where: object, function: Callable[..., Result], *args: object) -> Result:
        """
        Result of a function that reads the files named by ``where``.

        Raises
        ------
        IngestError
            With the text of a `StarcalError` of the function; naming the files, for another
            exception and for a call that exceeds a limit or crashes.
        """
        if self._process is None:
            self._process = _started()
        try:
            pickle.dump((function, args, self._limits_s), _pipe(self._process.stdin))
            _pipe(self._process.stdin).flush()
            answer: tuple[bool, Any] = pickle.load(_pipe(self._process.stdout))
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            raise IngestError(f'{where}: {self._reason(self._end())}') from error
        succeeded, result = answer
        if not succeeded:
            is_known, text = result
            raise IngestError(text if is_known else f'{where}: cannot be read: {text}')
        return result  # type: ignore[no-any-return]

    def _reason(self, status: int) -> str:
        """Reason for an exit status of the process."""
        if status == _NO_MEMORY:
            return 'needs more than 1 GB of memory to be read: damaged, or too large'
        if status == -signal.SIGPROF:
            return (
                f'takes more than {self._limits_s[0]:g} s of processor time to be read: damaged?'
            )
        if status == -signal.SIGALRM:
            return f'takes more than {self._limits_s[1]:g} s to be read: does it name a pipe?'
        return f'ends its reader with status {status}: damaged?'

    def _end(self) -> int:
        """End the process; returns its exit status."""
        process, self._process = self._process, None
        if process is None:
            return 0
        _pipe(process.stdout).close()
        with contextlib.suppress(OSError):  # what is left to write finds no reader
            _pipe(process.stdin).close()
        try:
            return process.wait(1.0)  # without input it ends by itself
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()


def _started() -> subprocess.Popen[bytes]:
    one_thread = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), '1')
    return subprocess.Popen(
        module_command('starcal_ros.ingest.guard'),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # warnings of libraries about the files
        env={**os.environ, **one_thread},
    )


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    assert pipe is not None  # all are pipes, see `_started`
    return pipe


def main() -> None:
    """Answer calls from the standard input until the parent closes it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends Ctrl-C here too
    answers = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # what a library prints is no answer
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            function, args, (processor_s, wall_s) = pickle.load(sys.stdin.buffer)
            # Their signals end the process, wherever it is: Python code could not.
            signal.setitimer(signal.ITIMER_PROF, processor_s)
            signal.setitimer(signal.ITIMER_REAL, wall_s)
            try:
                pickle.dump(_answer(function, args), answers)
                answers.flush()
            except MemoryError:
                os._exit(_NO_MEMORY)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.setitimer(signal.ITIMER_REAL, 0.0)


def _answer(function: Callable[..., object], args: tuple[object, ...]) -> tuple[bool, object]:
    """Success and the result, or False and an error: whether starcal raised it, and its text."""
    try:
        return True, function(*args)
    except MemoryError:
        raise
    except StarcalError as error:
        return False, (True, str(error))
    except Exception as error:
        words = ' '.join(f'{type(error).__name__} {error}'.split())
        return False, (False, words[:240])


if __name__ == '__main__':
    main()
