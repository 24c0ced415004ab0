# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""HTML report with its figures and pictures."""
