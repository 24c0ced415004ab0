# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images in files, and calibrations from images without attitudes."""
