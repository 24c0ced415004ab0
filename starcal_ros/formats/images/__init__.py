# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Image files: their headers, times and pixels."""
