# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The three methods of calibration as least-squares problems."""
