# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Entry points of the console scripts, with the default action for SIGINT during imports.

The imports take over a second; Python would answer Ctrl-C then with a traceback, the default
action of the system ends the process without one.  ``-m starcal_ros.entry_points NAME``
runs a node in the same way.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import os
import signal
import sys

_M_ARENA_MAX = -8  # of malloc.h
_REMEDY = (
    'Source the setup files of ROS 2 and of the workspace with starcal, or run it from the'
    ' environment that make setup makes'
)


def _run(name: str) -> int:
    """Run the function ``main`` of a module of `starcal_ros.ros`."""
    _keep_memory_in_one_place()
    # Read when NumPy is imported: see `starcal_ros.blas_threads`, which a vehicle may not have.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    # Unless nohup or a shell ignores it; `main` sets the handler of the node.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # `starcal play` and `starcal monitor` block it until here.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        module = importlib.import_module(f'starcal_ros.ros.{name}')
    except ImportError as error:
        if (error.name or '').startswith('starcal_ros'):
            raise
        if error.name in ('mcap', 'rosbags'):  # rosdep has no key for them
            why = f'{error.name} is not installed: pip install mcap rosbags'
        else:
            words = ' '.join(str(error).split())
            why = f'ROS 2 is not complete for {sys.executable}: {words}. {_REMEDY}'
        print(f'{name}: {why}', file=sys.stderr)
        return 2
    return int(module.main())


def _keep_memory_in_one_place() -> None:
    """
    Have the allocator of glibc serve all threads from one arena; before the first thread.

    By default each thread of an executor keeps the memory that it has freed: a calibrator that
    solved in turn on eight threads grew to twice its size.
    """
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:  # musl has one arena and no such function
        mallopt(_M_ARENA_MAX, 1)


star_observer = functools.partial(_run, 'star_observer')
calibrator = functools.partial(_run, 'calibrator')
bag_player = functools.partial(_run, 'bag_player')

if __name__ == '__main__':
    sys.exit(_run(sys.argv.pop(1)))
