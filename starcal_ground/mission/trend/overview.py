# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""One line on each camera of a fleet: changes found, and the camera that it was swapped with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starcal_ground.mission.trend.rows import Row
from starcal_ground.mission.trend.series import findings, Series
from starcal_ros.arrays import Floats, Indices

_ALIKE = 0.1  # largest difference to another camera, as a fraction of the step to it
_SIGMAS = 5.0  # with ten parameters of a thousand cameras, chance does not reach it


@dataclass(frozen=True)
class Overview:
    """
    A camera as a line among others.

    Attributes
    ----------
    name : str
    kinds : tuple of str
        Kinds of its terms; temperature asks for nothing to be done.
    is_stable : bool
        False if the newest calibration differs from the active one.
    after : int
        Index of the calibration before its most significant step; -1 without a step.
    time_ns : int array (n,)
    values : array (n, p)
        Camera parameters of its n calibrations, those of the alignment left out.
    sigma : array (p,)
        Of the calibration after the step.
    model : tuple
        Lens model and image size; only cameras with the same are compared.
    """

    name: str
    kinds: tuple[str, ...]
    is_stable: bool
    after: int
    time_ns: Indices
    values: Floats
    sigma: Floats
    model: tuple[str, int, int]

    @property
    def needs_attention(self) -> bool:
        """True for a step, a drift or a newest calibration that differs."""
        return self.verdict != 'sound'

    @property
    def verdict(self) -> str:
        """Stepped, drifting, changed since the active calibration; or sound."""
        words = {'step': 'stepped', 'drift': 'drifting'}
        found = [words[kind] for kind in self.kinds if kind in words]
        found += [] if self.is_stable else ['changed']
        return ', '.join(found) or 'sound'


def overview_of(
    name: str, rows: Sequence[Row], shown: Sequence[Series], is_stable: bool
) -> Overview:
    """Overview of the different calibrations of a camera, in order of time."""
    found = findings(shown)
    steps = [(abs(t.size) / t.sigma, one.row[t.after]) for one, t in found if t.kind == 'step']
    after = max(steps)[1] if steps else -1
    return Overview(
        name=name,
        kinds=tuple(sorted({term.kind for _, term in found})),
        is_stable=is_stable,
        after=after,
        time_ns=np.array([row.time_ns for row in rows], np.int64),
        values=np.array([row.values for row in rows], np.float64),
        sigma=np.array(rows[after + 1].sigmas[: len(rows[0].names)], np.float64),
        model=(rows[0].lens_model, rows[0].width, rows[0].height),
    )


def swapped_with(one: Overview, cameras: Sequence[Overview]) -> str:
    """
    Name of the camera whose parameters a camera has since its step; empty if there is none.

    Compared is the newest calibration of the other camera before the step, since the other one
    may have been swapped at the same time.
    """
    if one.after < 0:
        return ''
    before, after = one.values[one.after], one.values[one.after + 1]
    sigma = np.where(one.sigma > 0, one.sigma, np.inf)
    found = [(max(_SIGMAS, _ALIKE * float(np.max(np.abs(after - before) / sigma))), '')]
    for other in cameras:
        k = int(np.searchsorted(other.time_ns, one.time_ns[one.after], 'right')) - 1
        if other is not one and other.model == one.model and k >= 0:
            found.append((float(np.max(np.abs(after - other.values[k]) / sigma)), other.name))
    return min(found)[1]
