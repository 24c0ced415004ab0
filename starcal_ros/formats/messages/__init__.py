# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records to ROS message objects and back, without ROS."""
