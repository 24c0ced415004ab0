"""Measurements of time and memory, against other people's code where there is some."""

NAMES = ('solver', 'ensemble', 'measure', 'calibrate', 'observer')
"""The benches, each a module with ``run(quick)`` that prints its tables and returns them."""
