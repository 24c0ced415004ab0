# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether a calibration may become active."""
