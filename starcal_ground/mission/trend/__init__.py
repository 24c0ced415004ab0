# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrations of a camera, or of a fleet, over years."""
