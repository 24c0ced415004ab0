# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Entry points of the console scripts, with the default action for SIGINT during imports.

The imports take over a second; Python would answer Ctrl-C then with a traceback, the default
action of the system ends the process without one.  ``-m starcal_ros.entry_points NAME``
runs a node in the same way, or another module by its whole name.
"""

from __future__ import annotations

import functools
import importlib
import os
import signal
import sys

from starcal_ros.processes import use_one_arena

_REMEDY = (
    'Source the setup files of ROS 2 and of the workspace with starcal, or run it from the'
    ' environment that make setup makes'
)


_ON_GROUND = ('bag_player', 'setup_finder')  # nodes that a vehicle may not have


def _run(name: str) -> int:
    """Run the function ``main`` of the module of a node, or of another by its whole name."""
    use_one_arena()
    # Read when NumPy is imported: see `starcal_ros.processes`, which a vehicle may not have.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    # Unless nohup or a shell ignores it; `main` sets the handler of the node.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # `starcal play` and `starcal monitor` block it until here.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        package = 'starcal_ground' if name in _ON_GROUND else 'starcal_ros'
        module = importlib.import_module(name if '.' in name else f'{package}.ros.{name}')
    except ImportError as error:
        if error.name == 'starcal_ground':
            why = 'starcal_ground is not installed: build the workspace with -DSTARCAL_GROUND=ON'
        elif (error.name or '').startswith(('starcal_ros', 'starcal_ground')):
            raise
        elif error.name in ('mcap', 'rosbags'):  # rosdep has no key for them
            install = f'{sys.executable} -m pip install mcap rosbags'
            why = f'{error.name} is not installed: {install}'
        else:
            words = ' '.join(str(error).split())
            why = f'ROS 2 is not complete for {sys.executable}: {words}. {_REMEDY}'
        print(f'{name.rpartition(".")[2]}: {why}', file=sys.stderr)
        return 2
    return int(module.main())


star_observer = functools.partial(_run, 'star_observer')
calibrator = functools.partial(_run, 'calibrator')
bag_player = functools.partial(_run, 'bag_player')
setup_finder = functools.partial(_run, 'setup_finder')

if __name__ == '__main__':
    sys.exit(_run(sys.argv.pop(1)))
