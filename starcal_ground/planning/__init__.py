# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The images to take next."""
