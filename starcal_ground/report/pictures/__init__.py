# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Pictures of images and stars for the report."""
