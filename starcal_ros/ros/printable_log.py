# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Loggers of nodes that escape characters which act on a terminal, and fill no disk."""

from __future__ import annotations

import time
from typing import Any

from rclpy.impl import rcutils_logger
from rclpy.logging import LoggingSeverity
from rclpy.node import Node

from starcal_ros.text import printable

# rclpy keeps a severity for each line that logs; the line is that of the caller of this module.
rcutils_logger._internal_callers.append(__file__)

_AT_ONCE = 100.0
_EACH_S = 60.0


class PrintableLogger(rcutils_logger.RcutilsLogger):
    """
    A logger whose messages may quote names and texts from messages, bags and files.

    A line of code logs a hundred messages at once, and one a minute after them, with the number
    left out: images that are refused for a week fill no disk.  All are logged at DEBUG.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        # By line: messages that it may log, since when, and how many were left out.
        self._left: dict[Any, tuple[float, float, int]] = {}

    def log(self, message: str, severity: Any, **options: Any) -> bool:
        """Log a message."""
        if self.get_effective_level() > LoggingSeverity.DEBUG:
            line, now_s = rcutils_logger.CallerId(), time.monotonic()
            count, since_s, omitted = self._left.get(line, (_AT_ONCE, now_s, 0))
            count = min(count + (now_s - since_s) / _EACH_S, _AT_ONCE)
            if count < 1.0:
                self._left[line] = count, now_s, omitted + 1
                return False
            self._left[line] = count - 1.0, now_s, 0
            message += f' (and {omitted} left out)' if omitted else ''
        return bool(super().log(printable(message), severity, **options))


class PrintableLog(Node):
    """Base class of nodes whose log is printable."""

    def get_logger(self) -> PrintableLogger:
        """Return the logger of the node."""
        if not isinstance(self._logger, PrintableLogger):
            self._logger = PrintableLogger(self._logger.name)
        return self._logger
