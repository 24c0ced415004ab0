# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Benches of time, memory, accuracy and identification, some against other packages."""

NAMES = ('solver', 'ensemble', 'measure', 'calibrate', 'observer', 'gate')
"""The benches, each a module with ``run(quick)`` that prints its tables and returns them."""

LONG = (
    'accuracy',
    'trust',
    'worlds',
    'acquisition',
    'lost_in_space',
    'paper',
    'faults',
    'soak',
    'transport',
    'attack',
    'fleet',
)
"""Those that take some minutes: run when they are named."""
