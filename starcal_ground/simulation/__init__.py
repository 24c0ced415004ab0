# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated star fields, images and bags with known truth."""
