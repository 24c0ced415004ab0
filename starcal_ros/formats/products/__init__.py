# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The files that a calibration leaves."""
