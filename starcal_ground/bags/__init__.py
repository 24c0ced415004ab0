# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags of images: their topics, and their images with the telemetry about each."""
