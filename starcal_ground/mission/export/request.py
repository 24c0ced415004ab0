# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Inputs of an export besides the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starcal_ros.records import StarObservations

_INSTRUMENTS_PER_SPACECRAFT = 1000  # NAIF: instrument ID = 1000 * spacecraft ID - number


@dataclass(frozen=True)
class SpiceNames:
    """
    NAIF identifiers and frame names of a mission.

    ``instrument_id`` 0: ``1000 * spacecraft_id - 1``.  ``star_tracker_id`` 0: another frame kernel
    defines the star tracker frame; else the FK defines it as a CK frame of this number.  Empty
    frame names: those of the calibration.  ``pixel_size_um`` 0: not known.
    """

    spacecraft_id: int
    instrument_id: int = 0
    star_tracker_id: int = 0
    camera_frame: str = ''
    star_tracker_frame: str = ''
    pixel_size_um: float = 0.0

    @property
    def camera_id(self) -> int:
        """Identifier of the instrument and of its frame."""
        return self.instrument_id or _INSTRUMENTS_PER_SPACECRAFT * self.spacecraft_id - 1


@dataclass(frozen=True)
class Request:
    """
    Inputs of a format besides the calibration.

    ``names`` are None where the NAIF ID of the spacecraft is not given; ``table``: only the
    numbers of the calibration, for code that was compiled before; ``observations`` and ``kernels``
    (LSK and SCLK of the spacecraft) are those of the images, ``image_files`` the names of their
    files by stamp, where they are known; ``catalog`` is the file that identified their stars, None
    for that of the calibration.
    """

    names: SpiceNames | None = None
    table: bool = False
    observations: Sequence[StarObservations] = ()
    kernels: Sequence[Path] = ()
    catalog: Path | None = None
    image_files: Mapping[int, str] = field(default_factory=dict)
