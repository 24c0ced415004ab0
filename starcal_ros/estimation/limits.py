# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Limits that the estimate and its checks share, so that each question has one answer."""

from __future__ import annotations

FALSE_ALARM_RATE = 1e-4
"""Chance that a test of the data finds a fault in sound ones, at any of the places that it looks at:
each place has its part of it.  One of some hundred calibrations then fails one of the tests."""
FEWEST = 3
"""Members of a group that are judged: of two that differ, either may be the wrong one."""
FREE_FACTOR = 1e3
"""Factor on a 1-sigma that removes a prior, and by its inverse holds an unknown at its mean: no data
sheet is off by so many sigma, and a thousandth of a sigma moves no result."""
