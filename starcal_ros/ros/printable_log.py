# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Loggers of nodes that escape characters which act on a terminal."""

from __future__ import annotations

from typing import Any

from rclpy.impl import rcutils_logger
from rclpy.node import Node

from starcal_ros.text import printable

# rclpy keeps a severity for each line that logs; the line is that of the caller of this module.
rcutils_logger._internal_callers.append(__file__)


class PrintableLogger(rcutils_logger.RcutilsLogger):
    """A logger whose messages may quote names and texts from messages, bags and files."""

    def log(self, message: str, severity: Any, **options: Any) -> bool:
        """Log a message."""
        return bool(super().log(printable(message), severity, **options))


class PrintableLog(Node):
    """Base class of nodes whose log is printable."""

    def get_logger(self) -> PrintableLogger:
        """Return the logger of the node."""
        if not isinstance(self._logger, PrintableLogger):
            self._logger = PrintableLogger(self._logger.name)
        return self._logger
