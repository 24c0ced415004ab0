# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Entry point of the console script: signals and garbage collection of the process.

It answers Ctrl-C at any instant without a traceback.  During imports Python would print one; the
default action of the system ends the process silently.
"""

from __future__ import annotations

import gc
import signal
import sys

_AGAIN_S = 0.01
# Imports make many objects and few cycles: looking for these at every 700 takes 0.1 s.
_OBJECTS_BETWEEN_COLLECTIONS = 10_000


def main() -> int:
    """Run the tool; see `starcal_ros.cli.main.main`."""
    before = signal.getsignal(signal.SIGINT)
    is_default = before is signal.default_int_handler  # unless nohup or a shell ignores it
    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    from starcal_ros.cli import main as tool
    from starcal_ros.cli.arguments import on_interrupt

    if is_default:
        sys.unraisablehook = _interrupt_again
        signal.signal(signal.SIGALRM, on_interrupt)
        signal.signal(signal.SIGINT, on_interrupt)
    try:
        return tool.main()
    finally:
        if is_default:  # the result stands; Python's own end must not print a traceback
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGALRM, signal.SIG_IGN)
        gc.freeze()  # the end of the process frees all modules: looking for cycles takes 0.1 s


def _interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    """Raise a KeyboardInterrupt again that came in a destructor, where Python drops it."""
    if lost.exc_type is KeyboardInterrupt:
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
    else:
        sys.__unraisablehook__(lost)
