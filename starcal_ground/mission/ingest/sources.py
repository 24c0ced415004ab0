# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes and velocities from files of any format that is read here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcal_ground.mission.ingest import ccsds, kernels, mission_records
from starcal_ground.mission.ingest.mission_records import Attitudes, Velocities
from starcal_ros.errors import IngestError


def attitudes(paths: Sequence[Path], star_tracker: str, at_ns: Sequence[int]) -> Attitudes:
    """
    Attitudes from an AEM, a CSV table, or SPICE kernels at stamps.

    Raises IngestError when the files cannot be read.
    """
    if all(map(kernels.is_kernel, paths)):
        return kernels.read_ck(paths, star_tracker, at_ns)
    path = _one(paths)
    if ccsds.is_ccsds(path):
        return ccsds.read_aem(path, star_tracker)
    return mission_records.read_attitudes(path)


def velocities(paths: Sequence[Path], spacecraft: str, at_ns: Sequence[int]) -> Velocities:
    """
    Velocities from an OEM or SPICE kernels at the stamps of the images, or from a CSV table.

    Raises IngestError when the files cannot be read.
    """
    if all(map(kernels.is_kernel, paths)):
        return kernels.read_spk(paths, spacecraft, at_ns)
    path = _one(paths)
    if ccsds.is_ccsds(path):
        return ccsds.read_oem(path, at_ns)
    return mission_records.read_velocities(path)


def _one(paths: Sequence[Path]) -> Path:
    if len(paths) > 1:
        raise IngestError(f'{paths[1]}: one file, unless all are SPICE kernels')
    return paths[0]
