# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""How good a calibration is: observability, model checks, comparison, residuals."""
