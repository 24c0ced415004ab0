# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Queue and rates of the star observer, without ROS."""
