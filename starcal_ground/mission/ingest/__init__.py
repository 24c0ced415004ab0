# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images, attitudes and velocities in the formats of missions, to bags."""
