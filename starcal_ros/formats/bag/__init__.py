# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""MCAP bags: reading and writing."""
