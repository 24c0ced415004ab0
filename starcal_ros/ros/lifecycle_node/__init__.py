# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A lifecycle node: states, parameters, inputs and messages."""
