# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Limits that the estimate and its checks share, so that each question has one answer."""

from __future__ import annotations

FREE_FACTOR = 1e3
"""Factor on a 1-sigma that removes a prior, and by its inverse holds an unknown at its mean: no data
sheet is off by so many sigma, and a thousandth of a sigma moves no result."""
