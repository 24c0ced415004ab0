# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Processing steps shared by the nodes and the tool."""
