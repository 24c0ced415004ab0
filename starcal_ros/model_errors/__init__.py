# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Errors that no camera parameter describes: their tests and their variances."""
