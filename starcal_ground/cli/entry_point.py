# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Entry point of the console script, which answers Ctrl-C without a traceback.

During imports Python would print one; the default action of the system ends the process silently.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading

_AGAIN_S = 0.01


def main() -> int:
    """Run the tool; see `starcal_ground.cli.main.main`."""
    # Read when NumPy is imported: see `starcal_ros.processes`.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    # Unless nohup or a shell ignores it.
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from starcal_ground.cli import main as tool
    from starcal_ground.cli.arguments import on_interrupt

    if is_default:
        sys.unraisablehook = _interrupt_again
        signal.signal(signal.SIGINT, on_interrupt)
    try:
        return tool.main()
    finally:
        if is_default:  # the result stands; Python's own end must not print a traceback
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        gc.freeze()  # its last search for cycles among all objects would take 0.06 s


def _interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    """Interrupt again after a KeyboardInterrupt in a destructor, where Python drops it."""
    if lost.exc_type is KeyboardInterrupt:
        threading.Timer(_AGAIN_S, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)
