# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Residuals of stars, their normal equations and the solver."""
