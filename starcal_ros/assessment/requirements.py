# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Requirements on the sigma of a calibration, and the checks of the gate that answer them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import math
import re

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.observability import map_sigma_px
from starcal_ros.camera import INTRINSIC_NAMES
from starcal_ros.camera.lens import COEFFICIENTS
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.record_fields import nearest
from starcal_ros.records import ALIGNMENT_NAMES, Calibration, GateCheck, TOTAL
from starcal_ros.text import significant
from starcal_ros.untrusted import shown

OPTION = 'requirements'
LINE_OF_SIGHT, MAP, POINTING, FOCAL = 'line_of_sight', 'map', 'pointing', 'f'
_UNITS: dict[str, tuple[str, ...]] = {
    LINE_OF_SIGHT: ('arcsec',),
    MAP: ('arcsec', 'px'),
    POINTING: ('arcsec',),
    **dict.fromkeys([FOCAL, *INTRINSIC_NAMES], ('px',)),
    **dict.fromkeys(ALIGNMENT_NAMES, ('arcsec',)),
    **{name: ('',) for names in COEFFICIENTS.values() for name in names},
}
_FORM = re.compile(r'\s*(\w+)\s*=\s*([\d.]+(?:e-?\d+)?)\s*([a-z]*)\s*(?:@\s*([\d.]+)\s*%\s*)?')


@dataclass(frozen=True)
class Requirement:
    """
    An upper limit of a 1-sigma.

    ``quantity`` is ``line_of_sight``, ``map`` (the camera alone, the rotation common to the
    detector removed), each over a ``share`` of the detector; ``pointing`` (lines of sight in the
    star tracker frame, RMS over the detector), ``f`` (both focal lengths), or a parameter.

    >>> Requirement.of('line_of_sight=5arcsec@98%')
    Requirement(quantity='line_of_sight', limit=5.0, unit='arcsec', share=0.98)
    """

    quantity: str
    limit: float
    unit: str
    share: float = 1.0

    @classmethod
    def of(cls, text: str) -> Requirement:
        """Requirement of a text; raises OptionError with what is allowed."""
        match = _FORM.fullmatch(text)
        if match is None:
            raise OptionError(
                f'{OPTION}: {shown(text)} is not of the form line_of_sight=5arcsec@98%, map=0.1px,'
                ' pointing=10arcsec or f=0.1px'
            )
        quantity, number, unit, percent = match.groups()
        if quantity not in _UNITS:
            raise OptionError(
                f'{OPTION}: {quantity} is not line_of_sight, map, pointing, f or a'
                f' parameter{nearest(quantity, _UNITS)}'
            )
        if unit not in _UNITS[quantity]:
            over = f'@{percent}%' if percent and quantity in (LINE_OF_SIGHT, MAP) else ''
            written = ' or '.join(f'{quantity}={number}{name}{over}' for name in _UNITS[quantity])
            raise OptionError(f'{OPTION}: {text}: the unit does not fit: write {written}')
        try:
            limit, share = float(number), float(percent or 100.0) / 100.0
        except ValueError as error:
            raise OptionError(f'{OPTION}: {text}: not a number') from error
        if percent and quantity not in (LINE_OF_SIGHT, MAP):
            raise OptionError(f'{OPTION}: {text}: only line_of_sight and map are over a share')
        if not (limit > 0.0 and 0.0 < share <= 1.0):
            raise OptionError(
                f'{OPTION}: {text}: the sigma must be above 0, and the share at most 100 %'
            )
        return cls(quantity, limit, unit, share)

    @property
    def name(self) -> str:
        """The limited sigma in words."""
        what = {
            LINE_OF_SIGHT: '1-sigma of a line of sight',
            MAP: '1-sigma of the distortion map',
            POINTING: '1-sigma of the pointing, rms over the detector',
        }.get(self.quantity, f'1-sigma of {self.quantity}')
        if self.quantity not in (LINE_OF_SIGHT, MAP):
            return what
        share = f'{what} over {100 * self.share:g} % of the detector'
        return share if self.share < 1.0 else f'largest {what}'

    def sigma(self, calibration: Calibration) -> float:
        """The sigma of a calibration in the unit; NaN where a part of it is not known."""
        maps, scale = calibration.maps, 1.0 if self.unit != 'arcsec' else ARCSECOND_RAD
        if maps is None:
            raise ValueError('calibration: the gate needs its detector maps')
        if self.quantity == POINTING:
            budget = calibration.sigma_budget if calibration.has_alignment else ()
            return next((p.pointing_arcsec for p in budget if p.cause == TOTAL), math.nan)
        if self.quantity == LINE_OF_SIGHT:
            # Without an alignment the common rotation has no meaning.
            aligned = calibration.has_alignment
            full = maps.line_of_sight_sigma_arcsec if aligned else maps.shape_sigma_arcsec
            return self._over(full)
        if self.quantity == MAP and self.unit == 'arcsec':
            return self._over(maps.shape_sigma_arcsec)
        if self.quantity == MAP:
            try:
                camera = calibration.geometry.camera
                return self._over(map_sigma_px(camera, calibration.map_covariance))
            except np.linalg.LinAlgError:
                return math.nan
        names = ('fx', 'fy') if self.quantity == FOCAL else (self.quantity,)
        sigma = dict(zip(calibration.parameter_names, calibration.sigma, strict=True))
        # One that is held has no sigma of its own.
        return float(np.max([sigma.get(name, 0.0) or math.nan for name in names])) / scale

    def _over(self, sigma: Floats) -> float:
        """Upper limit of a sigma over the share; NaN where it has none."""
        known = np.where(np.isfinite(sigma), sigma, np.inf)
        limit = float(np.quantile(known, self.share, method='inverted_cdf'))
        return limit if math.isfinite(limit) else math.nan


def requirements_of(texts: Iterable[str]) -> tuple[Requirement, ...]:
    """Requirements of the option; raises OptionError for one that is not understood."""
    return tuple(Requirement.of(text) for text in texts if text)


def requirement_checks(calibration: Calibration, texts: Iterable[str]) -> Iterator[GateCheck]:
    """
    A check of each requirement, with by how much it is missed.

    Raises ValueError when the calibration has no maps.
    """
    for wanted in requirements_of(texts):
        sigma = wanted.sigma(calibration)
        passed = sigma <= wanted.limit  # NaN is not
        note = 'met' if passed else 'it is not estimated'
        if sigma > wanted.limit:
            unit = wanted.unit and f' {wanted.unit}'
            note = f'missed by {significant(sigma - wanted.limit, 2)}{unit}'
        yield GateCheck(wanted.name, OPTION, sigma, wanted.limit, wanted.unit, passed, note)


def answers(calibration: Calibration) -> tuple[str, ...]:
    """A sentence on each requirement of a judged calibration: the sigma, the limit, the note."""
    return tuple(
        f'{check.name} {check.found_text}, at most {check.limit_text} required: {check.note}'
        for check in calibration.gate
        if check.option == OPTION
    )
