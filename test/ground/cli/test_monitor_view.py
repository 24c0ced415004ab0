# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The view of running nodes: what it shows of what was received."""

from collections.abc import Mapping
import contextlib
import dataclasses
import io
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from sample_records import calibration, observations, status  # type: ignore[import-not-found]

from starcal_ground.cli.monitor_view import coverage_text, Received, share_of_limit, view
from starcal_ros.records import GateCheck, refused_image


def shown(received: Received, width: int = 80) -> str:
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(view(received))
    return console.export_text()


def check(found: float, limit: float, option: str = 'max_x', passed: bool = True) -> GateCheck:
    return GateCheck('residual per axis', option, found, limit, 'px', passed)


def test_nothing_received_is_said() -> None:
    why_none = 'calibration 1 is not active, the gate refuses it now'
    text, why = shown(Received()), shown(Received(why_none=why_none))
    for words in ('no image since', 'no status received', 'none active', 'no diagnostics'):
        assert words in text
    assert f'none active: the prior is in use: {why_none}'[:60] in why


@pytest.mark.parametrize(
    ('namespace', 'nodes', 'remedy'),
    [
        ('', ['sat1/calibrator', 'sat1/star_observer'], '--remap __ns:=/sat1'),
        ('sat2', ['sat1/calibrator', 'calibrator'], '--remap __ns:=/'),
        ('sat1', ['sat1/calibrator', 'sat2/calibrator'], ''),
        ('', ['calibrator', 'sat1/other'], ''),
    ],
)
def test_nodes_in_another_namespace_are_named(namespace, nodes, remedy) -> None:
    health = dict.fromkeys(nodes, (0, 'ok'))
    text = shown(Received(namespace=namespace, health=health))
    asked = f'nothing of calibrator in /{namespace}: try {remedy} '
    assert (asked in text) == bool(remedy) and ('no status received' in text) != bool(remedy)


def test_images_are_counted_by_reason_and_cell() -> None:
    coverage = coverage_text(np.array([[0, 1], [3, 4]])).plain.splitlines()
    assert coverage == ['most in a cell: 4', '··░░', '▓▓██']
    received = Received()
    for refusal in ('', 'no_match', '', 'no_match', 'frozen'):
        one = refused_image(1_700_000_000_000_000_000, 640, 512, refusal, 'of a detail')
        received = received.with_image(one)
    text = shown(received)
    assert '5 since the start of this view, 2 used' in text
    assert '2 refused: no match' in text and '1 refused: frozen' in text
    assert 'refused, frozen: of a detail' in text
    assert f'{len(observations())} stars' in shown(received.with_image(observations()))


def test_forecast_sigmas_stand_beside_the_active_ones() -> None:
    active = calibration()
    collected = dataclasses.replace(
        status(),
        parameter_names=('fx', 'alignment_x', 'k3'),
        predicted_sigma=np.array([0.25, 4.84813681e-06, np.inf]),
    )
    lines = shown(Received(status=collected, active=active)).splitlines()
    (fx,) = (line for line in lines if ' fx ' in line)
    assert '0.25 px' in fx and f'{active.sigma[0]:.2g}' in fx
    (turn,) = (line for line in lines if ' alignment_x ' in line)
    assert '1.00 arcsec' in turn
    (unknown,) = (line for line in lines if ' k3 ' in line)
    assert 'unobservable' in unknown


def test_a_refused_candidate_shows_the_failed_check_first() -> None:
    others = [check(0.9, 1.0) for _ in range(9)]
    wanted = dataclasses.replace(check(0.1, 1.0, option='requirements'), name='1-sigma of fx')
    gate = (check(0.5, 1.0), check(2.0, 1.0, passed=False), *others, wanted)
    candidate = dataclasses.replace(
        calibration(), accepted=False, reasons=('residual over the limit',), gate=gate
    )
    text = shown(
        Received(active=calibration(), candidate=candidate, health={'calibrator': (2, 'x')})
    )
    assert 'last candidate refused: residual over the limit' in text
    # Then the requirements, then the others by their share of the limit.
    assert text.index('██████████') < text.index('1-sigma of fx') < text.index('█████████·')
    assert 'calibrator: error x' in text
    told = {'calibrator': (1, 'refused by the gate: residual over the limit')}
    text = shown(Received(active=calibration(), candidate=candidate, health=told))
    assert text.count('residual over the limit') == 1


@pytest.mark.parametrize(
    ('found', 'limit', 'option', 'share'),
    [
        (0.5, 2.0, 'max_x', 0.25),
        (-3.0, 2.0, 'max_x', 1.5),
        (10.0, 5.0, 'min_x', 0.5),
        (0.0, 5.0, 'min_x', 1.0),
        (np.nan, 5.0, 'max_x', 0.0),
        (1.0, 0.0, 'max_x', 0.0),
    ],
)
def test_the_share_of_a_limit(found, limit, option, share) -> None:
    assert share_of_limit(check(found, limit, option)) == share


def test_health_and_gate_come_first_on_a_terminal_of_24_lines_and_80_columns() -> None:
    gate = tuple(
        dataclasses.replace(check(k / 10, 1.0, passed=k < 8), name=f'quantity {k} of the camera')
        for k in range(9)
    )
    refused = dataclasses.replace(calibration(), accepted=False, reasons=('over',), gate=gate)
    health = {'calibrator': (0, 'collecting'), 'star_observer': (1, 'no image matches')}
    received = Received(
        last=observations(),
        status=status(),
        active=calibration(),
        candidate=refused,
        health=health,
    )
    lines = shown(received, 80).splitlines()
    assert max(map(len, lines)) <= 80
    where = [
        next(k for k, line in enumerate(lines[:24]) if words in line)
        for words in ('star_observer: warning', 'calibrator: ok', 'refused: over', 'quantity 8',
                      'quantity 7', 'quantity 4', '─ images')
    ]  # fmt: skip
    assert where == sorted(where)


def hostile(value: Any) -> Any:
    """The same record with an escape sequence and a line break at the start of every text."""
    if isinstance(value, str):
        return f'\x1b[2J\ncalibrator: ok {value}'
    if isinstance(value, tuple):
        return tuple(map(hostile, value))
    if isinstance(value, Mapping):
        return {hostile(key): hostile(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.init]
        changed = {name: hostile(getattr(value, name)) for name in fields}
        with contextlib.suppress(ValueError):  # a lens model, which is checked
            return dataclasses.replace(value, **changed)
    return value


def test_no_text_of_a_message_acts_on_the_terminal() -> None:
    gate = (check(2.0, 1.0, passed=False), check(0.5, 1.0))
    sound = Received(
        last=refused_image(1, 640, 512, 'frozen', 'of a detail'),
        refused={'frozen': 1},
        status=status(),
        active=calibration(),
        candidate=dataclasses.replace(calibration(), reasons=('late',), gate=gate),
        health={'calibrator': (2, 'x')},
    )
    text = shown(hostile(sound), 500)
    assert '\x1b' not in text
    assert not any(line.lstrip('│ ').startswith('calibrator: ok') for line in text.splitlines())
    quoted = ('calibrator: error', 'of a detail', 'late', 'residual per axis', 'fx')
    for line in text.splitlines():
        if any(word in line for word in quoted):
            assert '\\x1b[2J\\ncalibrator: ok' in line
