# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Benches of time, memory, accuracy and identification, some against other packages."""

NAMES = ('solver', 'calibrate', 'observer')
"""The benches, each a module with ``run(quick)`` that yields its tables."""

LONG = (
    *('evidence', 'acquisition', 'lost_in_space', 'night_sky', 'narrow'),
    *('soak', 'fleet', 'peers'),
)
"""Those that take some minutes: run when they are named."""
