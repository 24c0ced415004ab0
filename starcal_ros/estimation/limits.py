# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Limits that the estimate and its checks share, so that each question has one answer."""

from __future__ import annotations

FALSE_ALARM_RATE = 1e-4
"""Chance that a test finds a fault in sound data, at any of its places: each has a part of it.

Ten times less would hide a drift of few images, ten times more refuse one calibration in 100.  Two
limits are wider by evidence: misfits of a stated star tracker, and priors that data contradict."""
FEWEST = 3
"""Members of a group that are judged: of two that differ, either may be the wrong one."""
MOST_CORRELATED = 100
"""Images, or groups of them, whose correlations are kept: algebra on all of more would take most
of the time of an estimate, and correlation times are a third of a campaign or more."""
ROWS_AT_ONCE = 8192
"""Rows of an array that are worked on at a time, measured: with fewer, calls into numpy take more
time, with more, the arrays do not stay in the cache."""
STEP_SIGMA = 0.05
"""Step in 1-sigma below which a search has ended: a twentieth of a sigma moves no result."""
LEAST_GAIN = 0.5 * STEP_SIGMA**2
"""The same as a change of the log likelihood, by which a search of amplitudes has ended."""
MOST_ROUNDS = 50
"""Steps after which a search is given up; three to ten are usual."""
NEGLIGIBLE = 0.02
"""Share of a variance without which its sigma is as good: by one in a hundred."""
ROUNDING = 1e-12
"""Relative rounding of a sum of a million products."""
FREE_FACTOR = 1e3
"""Factor on a 1-sigma that removes a prior, and by its inverse holds an unknown at its mean: no
data sheet is off by so many sigma, and a thousandth of a sigma moves no result."""
