# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Requirements on sigmas: their names and units, their texts, and the answer of a calibration.

`QUANTITIES` has the names, which ``starcal plan --minimise`` accepts too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
import functools
import math
import re

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.observability import map_sigma_px
from starcal_ros.assessment.remedies import remedy_against
from starcal_ros.camera import INTRINSIC_NAMES
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.record_fields import nearest
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    Calibration,
    DetectorMaps,
    GateCheck,
    SigmaPart,
    Statement,
    TOTAL,
)
from starcal_ros.text import significant
from starcal_ros.untrusted import shown

REQUIREMENTS, _NONE = 'requirements', 'none'
LINE_OF_SIGHT, MAP, POINTING, FOCAL = 'line_of_sight', 'map', 'pointing', 'f'
_LARGEST, _RMS = 'largest ', 'rms '  # over the detector


@dataclass(frozen=True)
class Quantity:
    """
    A 1-sigma that may be limited, or lowered by a plan.

    Attributes
    ----------
    units : tuple of str
        Units of a limit, the default first; empty text for a pure number.
    sigma : callable
        Returns it by calibration and unit, NaN where it is not estimated; all values over the
        detector if ``statistic`` is their largest.
    statistic : str
        `_LARGEST` or `_RMS` over the detector; empty for a parameter.
    of_camera, of_alignment : bool
        True if the camera alone, or the alignment, contributes to it.
    parameters : tuple of str
        Those of which it is the largest 1-sigma; empty over the detector.
    """

    units: tuple[str, ...]
    sigma: Callable[[Calibration, str], Floats | float]
    statistic: str = ''
    of_camera: bool = True
    of_alignment: bool = False
    parameters: tuple[str, ...] = ()

    def variance_arcsec2(self, part: SigmaPart) -> Floats:
        """
        Return the contribution of a cause to the variance: the mean, or (63,) over the detector.

        That of an alignment is taken as the same at all pixels.
        """
        of_map: tuple[float, ...] = (part.map_arcsec,)
        if self.statistic != _RMS:
            of_map = part.map_over_detector_arcsec or of_map
        turned = part.pointing_arcsec**2 - part.map_arcsec**2
        return np.square(of_map) * self.of_camera + turned * self.of_alignment


def maps_of(calibration: Calibration) -> DetectorMaps:
    """Return the detector maps of a calibration; raises ValueError where it has none."""
    if calibration.maps is None:
        raise ValueError('calibration: the gate needs its detector maps')
    return calibration.maps


def _line_of_sight(calibration: Calibration, _: str) -> Floats:
    # Without an alignment the common rotation has no meaning.
    maps, is_alone = maps_of(calibration), not calibration.has_alignment
    return maps.shape_sigma_arcsec if is_alone else maps.line_of_sight_sigma_arcsec


def _map(calibration: Calibration, unit: str) -> Floats | float:
    if unit == 'arcsec':
        return maps_of(calibration).shape_sigma_arcsec
    try:
        return map_sigma_px(calibration.geometry.camera, calibration.map_covariance)
    except np.linalg.LinAlgError:
        return math.nan


def _pointing(calibration: Calibration, _: str) -> float:
    budget = calibration.sigma_budget if calibration.has_alignment else ()
    return next((part.pointing_arcsec for part in budget if part.cause == TOTAL), math.nan)


def _of_parameters(names: tuple[str, ...], calibration: Calibration, unit: str) -> float:
    sigma = dict(zip(calibration.parameter_names, calibration.sigma, strict=True))
    if not calibration.has_alignment:
        sigma |= dict.fromkeys(ALIGNMENT_NAMES, 0.0)
    # A held parameter has no sigma of its own, nor has an alignment to no star tracker.
    known = [sigma.get(name, 0.0) or math.nan for name in names]
    return float(np.max(known)) / (ARCSECOND_RAD if unit == 'arcsec' else 1.0)


def _parameters(unit: str, *names: str, of_alignment: bool = False) -> Quantity:
    sigma = functools.partial(_of_parameters, names)
    return Quantity((unit,), sigma, '', not of_alignment, of_alignment, names)


QUANTITIES: Mapping[str, Quantity] = {
    LINE_OF_SIGHT: Quantity(('arcsec',), _line_of_sight, _LARGEST, of_alignment=True),
    MAP: Quantity(('arcsec', 'px'), _map, _LARGEST),
    POINTING: Quantity(('arcsec',), _pointing, _RMS, of_alignment=True),
    FOCAL: _parameters('px', 'fx', 'fy'),
    **{name: _parameters('px', name) for name in INTRINSIC_NAMES},
    **{name: _parameters('arcsec', name, of_alignment=True) for name in ALIGNMENT_NAMES},
    **{name: _parameters('', name) for lens in LENSES.values() for name in lens.coefficients},
}
"""Name -> row; `Requirement` describes each."""


@dataclass(frozen=True)
class Requirement:
    """
    An upper limit of a 1-sigma.

    ``name`` is ``line_of_sight``, ``map`` (the camera alone, the rotation common to the detector
    removed), each over a ``share`` of the detector; ``pointing`` (lines of sight in the star
    tracker frame, RMS over the detector), ``f`` (both focal lengths), or a parameter.

    >>> Requirement.of('line_of_sight=5arcsec@98%')
    Requirement(name='line_of_sight', limit=5.0, unit='arcsec', share=0.98)
    """

    name: str
    limit: float
    unit: str
    share: float = 1.0

    @classmethod
    def of(cls, text: str) -> Requirement:
        """Requirement of a text; raises OptionError with what is allowed."""
        number = r'((?:\d+\.?\d*|\.\d+)(?:e-?\d+)?)'
        form = rf'\s*(\w+)\s*=\s*{number}\s*([a-z]*)\s*(?:@\s*{number}\s*%\s*)?'
        match = re.fullmatch(form, text)
        if match is None:
            raise OptionError(
                f'{REQUIREMENTS}: {shown(text)} is not of the form line_of_sight=5arcsec@98%,'
                ' map=0.1px, pointing=10arcsec or f=0.1px'
            )
        name, number, unit, percent = match.groups()
        if name not in QUANTITIES:
            raise OptionError(
                f'{REQUIREMENTS}: {name} is not line_of_sight, map, pointing, f or a'
                f' parameter{nearest(name, QUANTITIES)}'
            )
        quantity = QUANTITIES[name]
        has_share = quantity.statistic == _LARGEST
        if unit not in quantity.units:
            over = f'@{percent}%' if percent and has_share else ''
            written = ' or '.join(f'{name}={number}{known}{over}' for known in quantity.units)
            raise OptionError(f'{REQUIREMENTS}: {text}: the unit does not fit: write {written}')
        limit, share = float(number), float(percent or 100.0) / 100.0
        if percent and not has_share:
            raise OptionError(
                f'{REQUIREMENTS}: {text}: only line_of_sight and map are over a share'
            )
        if not (0.0 < limit < math.inf and 0.0 < share <= 1.0):
            raise OptionError(
                f'{REQUIREMENTS}: {text}: the sigma must be finite and above 0, and the share at'
                ' most 100 %'
            )
        return cls(name, limit, unit, share)

    @property
    def quantity(self) -> Quantity:
        """Row of `QUANTITIES`."""
        return QUANTITIES[self.name]

    def __str__(self) -> str:
        """Return the limited sigma in words."""
        if self.share < 1.0:
            return f'1-sigma of {self.name} over {100 * self.share:g} %'
        return f'{self.quantity.statistic}1-sigma of {self.name}'

    def sigma(self, calibration: Calibration) -> float:
        """
        The sigma of a calibration in the unit; NaN where a part of it is not known.

        Raises ValueError when the calibration has no maps.
        """
        return self._over_share(self.quantity.sigma(calibration, self.unit))

    def _over_share(self, sigma: Floats | float) -> float:
        known = np.where(np.isfinite(sigma), sigma, np.inf)
        limit = float(np.quantile(known, self.share, method='inverted_cdf'))
        return limit if math.isfinite(limit) else math.nan

    def remedy(self, calibration: Calibration) -> str:
        """Against the largest cause of the sigma: what to state, and its gain, or a remedy."""
        causes = [part for part in calibration.sigma_budget if part.cause != TOTAL]
        if not causes:
            return ''
        largest = max(causes, key=lambda part: self.quantity.variance_arcsec2(part).max())
        for one in calibration.statements:
            if one.cause == largest.cause:
                return f'state {one.option}{self._gain(one, largest, calibration)}'
        return remedy_against(largest.cause)

    def _gain(self, stated: Statement, cause: SigmaPart, calibration: Calibration) -> str:
        """The sigma before and after a statement in words; empty of a parameter: not computed."""
        if self.quantity.parameters:
            return ''
        total = next(part for part in calibration.sigma_budget if part.cause == TOTAL)
        variance = self.quantity.variance_arcsec2(total)
        left = variance - stated.removed_share(cause) * self.quantity.variance_arcsec2(cause)
        falls = self._over_share(np.sqrt(left.clip(0.0))) / self._over_share(np.sqrt(variance))
        before = self.sigma(calibration)
        after = falls * before
        figures = [f'{significant(one, 2)} {self.unit}' for one in (before, after)]
        enough = '' if after <= self.limit else ', not enough'
        return f': {" becomes ".join(figures)} if it is {stated.value}{enough}'


def requirements_of(texts: Iterable[str]) -> tuple[Requirement, ...]:
    """Requirements of the option, none for ``none``; raises OptionError for any other text."""
    texts = tuple(texts)
    if '' in texts:  # a shell variable that is not set; without the option the defaults hold
        raise OptionError(
            f'{REQUIREMENTS}: an empty text is no requirement: leave the option out for the'
            ' defaults, or write none to require no sigma'
        )
    return () if texts == (_NONE,) else tuple(map(Requirement.of, texts))


def requirement_checks(calibration: Calibration, texts: Iterable[str]) -> Iterator[GateCheck]:
    """
    A check of each requirement, with by how much it is missed and what lowers the sigma.

    Raises ValueError when the calibration has no maps.
    """
    for wanted in requirements_of(texts):
        sigma = wanted.sigma(calibration)
        passed = sigma <= wanted.limit  # NaN is not
        note = 'met' if passed else 'it is not estimated'
        if sigma > wanted.limit:
            unit = wanted.unit and f' {wanted.unit}'
            missed = f'missed by {significant(sigma - wanted.limit, 2)}{unit}'
            note = '; '.join(filter(None, [missed, wanted.remedy(calibration)]))
        yield GateCheck(str(wanted), REQUIREMENTS, sigma, wanted.limit, wanted.unit, passed, note)


def requirement_answers(calibration: Calibration) -> tuple[str, ...]:
    """A sentence on each requirement of a judged calibration: the sigma, the limit, the note."""
    return tuple(
        f'{check.name} {check.found_text}, at most {check.limit_text} required: {check.note}'
        for check in calibration.gate
        if check.option == REQUIREMENTS
    )
