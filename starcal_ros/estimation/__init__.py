# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""From observations to camera, alignment and covariance."""
