# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star catalog, apparent directions of stars, and star-tracker attitudes."""
