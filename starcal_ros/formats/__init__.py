# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags, messages, products and image files: strict reading, atomic writing."""
