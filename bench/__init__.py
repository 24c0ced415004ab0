"""Measurements of time, memory and accuracy, against other people's code where there is some."""

NAMES = ('solver', 'ensemble', 'measure', 'calibrate', 'observer', 'gate')
"""The benches, each a module with ``run(quick)`` that prints its tables and returns them."""

LONG = ('accuracy', 'paper', 'faults', 'soak', 'transport')
"""Those that take some minutes: run when they are named."""
