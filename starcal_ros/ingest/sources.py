# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes and velocities from files of any format that is read here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcal_ros.ingest import ccsds, kernels, tables
from starcal_ros.ingest.records import Attitudes, IngestError, Velocities


def attitudes(paths: Sequence[Path], star_tracker: str, at_ns: Sequence[int]) -> Attitudes:
    """
    Attitudes from an AEM, a CSV table, or SPICE kernels at the stamps of the images.

    Raises
    ------
    IngestError
        When the files cannot be read.
    """
    if all(map(kernels.is_kernel, paths)):
        return kernels.read_ck(paths, star_tracker, at_ns)
    path = _one(paths)
    if ccsds.is_ccsds(path):
        return ccsds.read_aem(path, star_tracker)
    return tables.read_attitudes(path)


def velocities(paths: Sequence[Path], spacecraft: str, at_ns: Sequence[int]) -> Velocities:
    """
    Velocities from an OEM or SPICE kernels at the stamps of the images, or from a CSV table.

    Raises
    ------
    IngestError
        When the files cannot be read.
    """
    if all(map(kernels.is_kernel, paths)):
        return kernels.read_spk(paths, spacecraft, at_ns)
    path = _one(paths)
    if ccsds.is_ccsds(path):
        return ccsds.read_oem(path, at_ns)
    return tables.read_velocities(path)


def _one(paths: Sequence[Path]) -> Path:
    if len(paths) > 1:
        raise IngestError(f'{paths[1]}: one file, unless all are SPICE kernels')
    return paths[0]
