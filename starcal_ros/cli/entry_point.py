"""
Entry point of the console script, with the default action for SIGINT during imports.

Python would answer Ctrl-C then with a traceback; the default action of the system ends the process
without one.
"""

from __future__ import annotations

import signal


def main() -> int:
    """Run the tool; see `starcal_ros.cli.main.main`."""
    before = signal.getsignal(signal.SIGINT)
    is_default = before is signal.default_int_handler  # unless nohup or a shell ignores it
    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from starcal_ros.cli import main as tool

    signal.signal(signal.SIGINT, before)
    try:
        return tool.main()
    finally:
        if is_default:  # the result stands; Python's own end must not print a traceback
            signal.signal(signal.SIGINT, signal.SIG_IGN)
