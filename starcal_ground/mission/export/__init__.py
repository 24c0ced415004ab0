# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrations in the formats of other tools."""
