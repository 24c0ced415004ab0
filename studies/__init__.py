# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Monte Carlo studies, the reproduction of the paper, and worlds that differ from the model."""
