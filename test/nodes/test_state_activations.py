# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Activations and roll-backs: each is judged by the gate of that moment, and can be read again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re

from calibrators import Calibrators  # type: ignore[import-not-found]
import pytest

from starcal_ros.constants import MAX_STAMP_NS

pytestmark = pytest.mark.slow


@pytest.fixture
def calibrators(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Calibrators]:
    made = Calibrators(tmp_path, monkeypatch)
    yield made
    made.close_all()


# Steps, words of the answer to the last request, and the calibration that is active then.  A
# candidate moves the corners by so many px; the limit is 0.3 px, 1.5 px from the prior.
ACTIVATIONS = {
    # Another request changes the active calibration during the solve.
    'refused against 1 after a roll-back': (
        'activate a; activate b 0.25; solve c 0.5 while rollback',
        'refused by the gate: largest change',
        'a',
    ),
    'accepted against 1 after a roll-back': (
        'activate a; activate b 0.25; solve c 0.2 while rollback',
        'activated: ',
        'c',
    ),
    'refused at the start, accepted after a roll-back': (
        'activate a; activate b 0.25; activate c 0.5; rollback; solve d 0.55 while rollback',
        'refused by the gate: largest change',
        'a',
    ),
    'of a roll-back that makes it acceptable': (
        'activate a; activate b 0.25; activate c 0.5; solve d 0.1 while rollback',
        'activated: ',
        'd',
    ),
    'by force after a roll-back': (
        'activate a; activate b 0.25; solve c 0.5 force while rollback',
        'activated: ',
        'c',
    ),
    'dry run after a roll-back': (
        'activate a; activate b 0.25; solve c 0.5 dry_run while rollback',
        'refused by the gate: largest change',
        'a',
    ),
    # Roll-backs past calibrations that were forced, withheld or are refused by the gate today.
    'past a forced one': ('activate a; activate b 2 force; rollback', 'activated again: ', 'a'),
    'to a forced one': (
        'activate a 0.25; activate b 2 force; activate c 2.25 force; rollback',
        'activated again: ',
        'b',
    ),
    'past a forced one that came while others were withheld': (
        'activate a 0.2; limit 0.01; open A; activate b 0.25 force; limit 0.3; open A; rollback',
        'activated again: ',
        'a',
    ),
    'past one that is refused today': (
        'activate a; activate b 0.2; activate c 0.45; activate d 0.3; limit .08; open A; rollback',
        'calibration 3 is not active, the gate refuses it now: largest change',
        'b',
    ),
    'to none but refused ones': (
        'activate a 0.5; activate b 0.25; limit 0.08; open A; rollback',
        'calibration 1 is not active, the gate refuses it now: largest change',
        'b',
    ),
    'from one that a roll-back made active before a restart': (
        'activate a; activate b .1; activate c .2; rollback; kill; open A; rollback',
        'activated again: ',
        'a',
    ),
    'to one that was active when the active one came': (
        'activate a; activate b .1; activate c .2; rollback; rollback; activate d .1; rollback',
        'activated again: ',
        'a',
    ),
    'to none': ('activate a; rollback', 'there is no calibration before the active one', 'a'),
    # The limits change, and with them what is active.
    'withheld': ('activate a 0.25; limit 0.01; open A; rollback', 'no calibration is active', ''),
    'relaxed': ('activate a 0.25; limit 0.01; open A; limit 0.3; open A; solve b 0.5', 'act', 'b'),
    'withheld with another mounting': (
        'activate a; turn 90; open A; rollback',
        'no calibration is active',
        '',
    ),
    'relaxed again': (
        'activate a 0.25; limit 0.01; open A; limit 0.3; open A; solve b 2',
        'refused by the gate: largest change',
        'a',
    ),
    'withheld in memory': (
        'open -; activate a 0.25; limit 0.01; open -; rollback',
        'no calibration is active',
        '',
    ),
    'relaxed again in memory': (
        'open -; activate a 0.25; limit .01; open -; limit 0.3; open -; solve b 2; open A',
        'refused by the gate: largest change',
        'a',
    ),
    'during a solve': (
        'activate a; limit 0.2; solve b 0 while open A',
        'not activated: the node was cleaned up meanwhile',
        'a',
    ),
    'during a solve in memory': (
        'open -; activate a; limit 0.2; solve b 0 while open -; open A',
        'not activated: the node was cleaned up meanwhile',
        'a',
    ),
    # The answer has the requirements.
    'met': (
        'require line_of_sight=1000arcsec@98%; open A; solve a',
        'activated: .* arcsec, at most 1000 arcsec required: met',
        'a',
    ),
    'missed': (
        'require f=1e-6px; open A; solve a',
        r'over the limit of 0.000001 px \(requirements\); missed by',
        '',
    ),
    # A clock that no stamp holds: nothing is written that its reader sets aside.
    'before 1970': ('activate a; clock -1; solve b', 'not activated, nobody could read', 'a'),
    'after 2038': (
        f'activate a; clock {MAX_STAMP_NS + 1}; solve b',
        f'active_since_ns: {MAX_STAMP_NS + 1} .*; check the ROS clock',
        'a',
    ),
    'rolled back after 2038': (
        f'activate a; activate b; clock {MAX_STAMP_NS + 1}; rollback',
        'not activated, nobody could read it',
        'b',
    ),
    'no /clock yet': ('activate a; clock 0; solve b', 'not activated: the ROS clock is 0', 'a'),
    '1970': ('activate a; clock 1; solve b', 'activated: ', 'b'),
    '2038': (f'activate a; clock {MAX_STAMP_NS}; solve b', 'activated: ', 'b'),
}


@pytest.mark.parametrize('name', ACTIVATIONS)
def test_what_is_activated_passes_the_gate_of_that_moment(
    name: str, calibrators: Calibrators
) -> None:
    """The answer says what is active; so it is after a restart, and no file is set aside."""
    steps, words, active = ACTIVATIONS[name]
    calibrators.run('limit 0.3; open A')
    state = calibrators.run(steps)
    answer = calibrators.answer
    times_ns = [record.calibration.active_since_ns for record in state._history]
    assert times_ns == sorted(times_ns)
    assert re.search(words, answer.message), answer.message
    for _ in range(2):
        found = state.active
        assert (found.weakest_direction if found else '') == active
        calibrators.run('kill')
        state = calibrators.run('open A')
        assert state.damage == ()


def test_history_is_bounded(calibrators: Calibrators, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('starcal_ros.ros.state.HISTORY', 2)
    calibrators.run('open A; activate a; activate b; activate c')
    assert len(list((calibrators.disk / 'A' / 'calibrations').iterdir())) == 2
    state = calibrators.run('rollback; rollback')
    gone = 'there is no calibration before the active one on record'
    assert calibrators.answer.message == gone
    assert state.active is not None and state.active.weakest_direction == 'b'
