# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands of the tool that are longer than a function."""
