# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calls of readers in a child process with limits of memory and time.

A file of a few megabytes can inflate to gigabytes, keep a library busy for minutes, name a pipe
that nobody writes to, or crash compiled code.  No reader can exclude all of that for its format:
here it ends the child process, and costs the file one line.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
import os
import resource
import signal
from typing import TYPE_CHECKING, TypeVar

from starcal_ros.errors import IngestError, StarcalError
from starcal_ros.processes import ChildProcess, ProcessEnded

if TYPE_CHECKING:
    from typing_extensions import Self

Result = TypeVar('Result')

_ADDRESS_SPACE = 9 << 27  # bytes; Python and the libraries take 0.5 GB, of which 0.1 are in memory


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
        self._process: ChildProcess | None = None

    def __enter__(self) -> Self:
        """Return the guard; its process starts with the first call."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        if self._process is not None:
            self._process.end()
            self._process = None

    def call(self, where: object, function: Callable[..., Result], *args: object) -> Result:
        """
        Result of a function that reads the files named by ``where``.

        Raises IngestError with the text of a `StarcalError` of the function; naming the files, for
        another exception and for a call that exceeds a limit or crashes.
        """
        self._process = process = self._process or ChildProcess()
        limited = functools.partial(_limited, self._limits_s, function)
        try:
            return process.call(limited, *args)
        except ProcessEnded as error:
            self._process = None
            raise IngestError(f'{where}: {self._reason(error.args[0])}') from error
        except StarcalError as error:
            raise IngestError(str(error)) from error
        except MemoryError as error:
            raise IngestError(
                f'{where}: needs more than 1 GB of memory to be read: damaged, or too large'
            ) from error
        except Exception as error:
            words = ' '.join(f'{type(error).__name__} {error}'.split())
            raise IngestError(f'{where}: cannot be read: {words[:240]}') from error

    def _reason(self, status: int) -> str:
        """Reason for an exit status of the process."""
        if status == -signal.SIGPROF:
            return (
                f'takes more than {self._limits_s[0]:g} s of processor time to be read: damaged?'
            )
        if status == -signal.SIGALRM:
            return f'takes more than {self._limits_s[1]:g} s to be read: does it name a pipe?'
        return f'ends its reader with status {status}: damaged?'


def _limited(
    limits_s: tuple[float, float], function: Callable[..., Result], *args: object
) -> Result:
    """Result of a function in this process, which ends where it exceeds a limit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # warnings of libraries about the files
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    # Their signals end the process, wherever it is: Python code could not.
    timers = (signal.ITIMER_PROF, signal.ITIMER_REAL)
    for timer, limit_s in zip(timers, limits_s, strict=True):
        signal.setitimer(timer, limit_s)
    try:
        return function(*args)
    finally:
        for timer in timers:
            signal.setitimer(timer, 0.0)
