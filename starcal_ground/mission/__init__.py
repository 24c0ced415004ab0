# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Around a campaign: import of mission formats, export to other tools, fleets over years."""
