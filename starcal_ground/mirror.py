# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Flips of mirrored image files; imports nothing, since `starcal --help` reads their names."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.typing import NDArray

MIRRORED = {'left-right': 'mirrored left to right', 'top-bottom': 'mirrored top to bottom'}
"""Words, by the name of a flip, of the provenance of a calibration of mirrored image files."""


def mirrored(values: NDArray[Any], flip: str) -> NDArray[Any]:
    """Values (height, width, ...) of an image after a flip of `MIRRORED`; '': as they are."""
    if flip == 'top-bottom':
        return values[::-1]
    return values[:, ::-1] if flip else values


def flips_in(pixels_of: str) -> list[str]:
    """Flips that the provenance of a calibration names, in its words on pixels."""
    return [flip for flip, words in MIRRORED.items() if words in pixels_of]
