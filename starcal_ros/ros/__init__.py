# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes: the only room that imports rclpy and generated messages."""
