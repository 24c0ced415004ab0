"""Measurements of time, memory, accuracy and wrong matches, some against other people's code."""

NAMES = ('solver', 'ensemble', 'measure', 'calibrate', 'observer', 'gate')
"""The benches, each a module with ``run(quick)`` that prints its tables and returns them."""

LONG = ('accuracy', 'acquisition', 'lost_in_space', 'paper', 'faults', 'soak', 'transport')
"""Those that take some minutes: run when they are named."""
