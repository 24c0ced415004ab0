# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Monte Carlo studies and the reproduction of the paper."""
