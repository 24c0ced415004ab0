# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""View of running nodes for a terminal: images, refusals, forecast sigmas, gate, health."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text

from starcal_ground.report import verdict
from starcal_ros.arrays import Floats
from starcal_ros.assessment.requirements import REQUIREMENTS
from starcal_ros.constants import utc_text
from starcal_ros.records import Calibration, EnsembleStatus, GateCheck, StarObservations
from starcal_ros.text import counted, printable

_HEALTH = {0: ('ok', 'green'), 1: ('warning', 'yellow'), 2: ('error', 'bold red')}
_STALE = ('stale', 'yellow')
_SHADES = ' ░▒▓█'
_TIGHTEST = 4  # gate checks shown of a calibration that passed


@dataclass(frozen=True)
class Received:
    """
    Newest messages of each topic; None or empty before the first.

    ``health`` has level and message of each node by its full name without the first slash;
    ``namespace`` is that of the topics, without it too.
    """

    namespace: str = ''
    images: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    last: StarObservations | None = None
    status: EnsembleStatus | None = None
    active: Calibration | None = None
    why_none: str = ''  # why a calibration was withdrawn
    candidate: Calibration | None = None
    health: Mapping[str, tuple[int, str]] = field(default_factory=dict)

    def with_image(self, observations: StarObservations) -> Received:
        """A copy with one more image."""
        refused = Counter(self.refused)
        if observations.refusal:
            refused[observations.refusal] += 1
        return replace(self, images=self.images + 1, refused=dict(refused), last=observations)


class Line(Text):
    """A line with control characters escaped, because other processes choose the names."""

    def __init__(self, text: str = '', style: str = '') -> None:
        super().__init__(printable(text), style)

    def append(self, text: Text | str, style: Style | str | None = None) -> Line:
        """Append words."""
        super().append(printable(text) if isinstance(text, str) else text, style)
        return self


def _lines(lines: Iterable[Text]) -> Text:
    return Text('\n').join(lines)


def view(received: Received) -> Group:
    """All panels in one column of 80 characters; health and gate are in the first 24 lines."""
    return Group(
        Panel(_health(received.health), title='nodes', title_align='left'),
        Panel(_calibration(received), title='calibration', title_align='left'),
        Panel(_images(received), title='images', title_align='left'),
        Panel(_ensemble(received), title='ensemble', title_align='left'),
    )


def _nothing_of(received: Received, node: str, words: str) -> Line:
    """Words on a node without messages, or the remedy if it runs in other namespaces only."""
    places = (name.rpartition('/') for name in received.health)
    namespaces = sorted(namespace for namespace, _, name in places if name == node)
    if not namespaces or received.namespace in namespaces:
        return Line(words, 'dim')
    return Line(
        f'nothing of {node} in /{received.namespace}: try --remap __ns:=/{namespaces[0]}', 'yellow'
    )


def _images(received: Received) -> Text:
    last = received.last
    if last is None:
        return _nothing_of(received, 'star_observer', 'no image since the start of this view')
    refused = sum(received.refused.values())
    lines = [
        Line(f'{received.images} since the start of this view, {received.images - refused} used')
    ]
    for reason, count in sorted(received.refused.items(), key=lambda item: -item[1]):
        lines.append(Line(f'  {count} refused: {reason.replace("_", " ")}', 'yellow'))
    line = Line(f'last {utc_text(last.time_ns)}: ')
    if last.refusal:
        line.append(f'refused, {last.refusal.replace("_", " ")}: {last.detail}', 'yellow')
    else:
        line.append(counted(len(last), 'star'), 'green')
    return _lines([*lines, line])


def _ensemble(received: Received) -> Group | Text:
    status = received.status
    if status is None:
        return _nothing_of(received, 'calibrator', 'no status received from a calibrator')
    head = Line()
    for there, needed, what in (
        (status.images, status.min_images, 'images'),
        (status.stars, status.min_stars, 'stars'),
    ):
        style = 'green' if there >= needed else 'yellow'
        head.append(f'{there} of at least {needed} {what}', style).append('   ')
    head.append(f'{status.images_saved} images on disk')
    sigmas = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name, justify in (('1-sigma of', 'left'), ('calibrated now', 'right'),
                          ('active', 'right')):  # fmt: skip
        sigmas.add_column(name, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    active = _sigmas(received.active)
    for name, sigma in zip(status.parameter_names, status.predicted_sigma, strict=True):
        before = active.get(name)
        style = 'green' if before is not None and sigma < before else ''
        sigmas.add_row(
            Line(name),
            Line(verdict.sigma_text(name, float(sigma)), style),
            Line('' if before is None else verdict.sigma_text(name, before)),
        )
    grid = Table.grid(padding=(0, 3))
    grid.add_row(sigmas, coverage_text(status.coverage))
    return Group(head, grid)


def coverage_text(coverage: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Text:
    """Coverage of the detector as shades, two characters per cell; empty cells are red."""
    most = max(int(coverage.max(initial=0)), 1)
    lines = [Line(f'most in a cell: {most}')]
    for row in coverage:
        line = Line()
        for count in row:
            if count == 0:
                line.append('··', 'red')
            else:
                line.append(2 * _SHADES[1 + int(3 * count // most)], 'cyan')
        lines.append(line)
    return _lines(lines)


def _sigmas(calibration: Calibration | None) -> dict[str, float]:
    if calibration is None:
        return {}
    sigma: Floats = calibration.sigma
    return dict(zip(calibration.parameter_names, sigma.tolist(), strict=True))


def _calibration(received: Received) -> Group | Text:
    parts: list[Text | Table] = []
    if received.active is None:
        why_none = f': {received.why_none}' if received.why_none else ''
        style = 'yellow' if why_none else 'dim'
        parts.append(Line(f'none active: the prior is in use{why_none}', style))
    else:
        active = received.active
        style = 'green' if active.accepted else 'bold red'
        words = 'accepted by the gate' if active.accepted else 'activated against the gate'
        parts.append(
            Line(
                f'active: number {active.number}, {words}, since'
                f' {utc_text(active.active_since_ns)}, {active.images_used} images,'
                f' residual {active.residual_rms_px:.3f} px',
                style,
            )
        )
    last = received.candidate or received.active
    if received.candidate is not None:
        reasons = '; '.join(received.candidate.reasons)
        is_above = any(reasons in text for _, text in received.health.values())
        parts.append(
            Line(f'last candidate refused{"" if is_above else f": {reasons}"}', 'bold red')
        )
    if last is not None:
        parts.append(_gate(last))
    return Group(*parts)


def _gate(calibration: Calibration) -> Table:
    """Failed checks, requirements, then the other passed ones closest to their limits."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column('gate check')
    table.add_column('value', justify='right')
    table.add_column('limit', justify='right')
    table.add_column('of the limit')
    failed = [check for check in calibration.gate if check.passed is False]
    passed = sorted(
        (check for check in calibration.gate if check.passed and share_of_limit(check) > 0),
        key=lambda check: (check.option == REQUIREMENTS, share_of_limit(check)),
        reverse=True,
    )
    for check in [*failed, *passed[:_TIGHTEST]]:
        share = min(share_of_limit(check), 1.0)
        style = 'bold red' if check.passed is False else ''
        table.add_row(
            Line(check.name, style),
            Line(check.found_text, style),
            Line(check.limit_text),
            Line('█' * round(10 * share) + '·' * (10 - round(10 * share)), style or 'cyan'),
        )
    return table


def share_of_limit(check: GateCheck) -> float:
    """Value of a check as a fraction of its limit; 0 without a number or a limit."""
    if not (np.isfinite(check.found) and np.isfinite(check.limit) and check.limit > 0):
        return 0.0
    if check.is_least:
        return check.limit / check.found if check.found > 0 else 1.0
    return abs(check.found) / check.limit


def _health(health: Mapping[str, tuple[int, str]]) -> Text:
    lines = list(_health_lines(health))
    return _lines(lines) if lines else Line('no diagnostics received', 'dim')


def _health_lines(health: Mapping[str, tuple[int, str]]) -> Iterator[Text]:
    for name, (level, message) in sorted(health.items(), key=lambda one: (-one[1][0], one[0])):
        words, style = _HEALTH.get(level, _STALE)
        yield Line(f'{name}: ').append(words, style).append(f' {message}')
