# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
OpenCV, loaded by the first use of one of its names.

A calibrator imports the modules that measure stars, for their options, but never calls them: it
does without the 15 MB of OpenCV.  These modules import it from here, others import it themselves.
"""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """Return the function, constant or class of OpenCV of a name."""
    if name.startswith('__'):  # what a module says of itself, such as its names to export
        raise AttributeError(name)
    import cv2

    return getattr(cv2, name)
