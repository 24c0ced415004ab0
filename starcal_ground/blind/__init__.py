# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""From the brightest sources of one image to its stars, without attitude or alignment."""
