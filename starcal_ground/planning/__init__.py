# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Contents of a bag, and the images to take next."""
