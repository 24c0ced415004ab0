# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Process that calls a function with the items that its parent sends: ``python -m`` of this module.

It reads pickles from its standard input, a pipe that only the parent holds: the path of imports,
the function, then items.  It writes one pickle for each item, the result or the exception.
There is no socket, so no other user can send it code.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys


def main() -> None:
    """Answer until the parent closes the pipe, as it does when it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends Ctrl-C here too
    answers = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # what a library prints is no answer
    with contextlib.suppress(EOFError, BrokenPipeError):
        sys.path[:] = pickle.load(sys.stdin.buffer)
        function = pickle.load(sys.stdin.buffer)
        while True:
            item = pickle.load(sys.stdin.buffer)
            try:
                answer = (True, function(item))
            except Exception as error:
                answer = (False, error)
            pickle.dump(answer, answers)
            answers.flush()


if __name__ == '__main__':
    main()
