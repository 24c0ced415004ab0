# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""State of a calibrator between requests, without ROS."""
