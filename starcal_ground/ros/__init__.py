# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Clients of the nodes for the tool."""
