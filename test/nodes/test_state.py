# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibrator keeps: in memory, on disk, across restarts, and what it answers."""

import contextlib
import dataclasses
import itertools
import json
from pathlib import Path
import re
import shutil
from typing import Any

from attacks import bag_setup, observations  # type: ignore[import-not-found]
from calibrators import scripts  # type: ignore[import-not-found]
from kept_state import full_disk  # type: ignore[import-not-found]
import pytest

from starcal_ros.constants import MAX_STAMP_NS
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.pipeline import solve as solving
from starcal_ros.pipeline.setup import CalibratorOptions, Setup
from starcal_ros.records import Ensemble, refused_image, StarObservations
from starcal_ros.ros.archive import Archive, CHECKSUMS
from starcal_ros.ros.state import CalibratorState


def started(folder: Path | str = '', given: Setup | None = None) -> CalibratorState:
    """A state that is open, with the setup of the small bag or another one."""
    state = CalibratorState(itertools.count(1).__next__)
    state.open(given or bag_setup(), CalibratorOptions(state_dir=str(folder)))
    return state


def filled(
    shown: tuple[StarObservations, ...], folder: Path | str = '', given: Setup | None = None
) -> CalibratorState:
    state = started(folder, given)
    for image in shown:
        state.add(image)
    return state


@pytest.mark.slow
def test_a_restart_goes_on_where_it_stood(tmp_path) -> None:
    first = filled(observations(), tmp_path)
    first.add(refused_image(5, 8, 8, 'no_stars', ''))
    answer = first.solve()
    assert answer.success and answer.active and answer.calibration is not None
    assert (answer.calibration.number, answer.calibration.active_since_ns) == (1, 1)
    status = first.status()
    assert status.images == status.images_saved == len(observations())
    first.close()
    second = started(tmp_path)
    assert dict(second.status().refused) == {'no_stars': 1}
    active, again = second.active, second.solve().calibration
    assert active is not None and again is not None
    for found in (active, again):
        assert found.covariance.tobytes() == answer.calibration.covariance.tobytes()
        assert found.provenance == answer.calibration.provenance
    assert (active.number, again.number) == (1, 2)
    second.close()


@pytest.mark.parametrize(
    ('images', 'words'),
    [
        ([], ''),
        (
            [('no_match', '23 star-like sources'), ('no_match', 'The images are mirrored.')],
            '; 2 images refused as no_match: The images are mirrored; ask starcal diagnose, or',
        ),
        ([('glare', '')] * 2 + [('no_stars', '1 source')], '; 2 images refused as glare: '),
    ],
)
def test_a_request_without_images_is_answered_with_the_cause(images, words) -> None:
    state = started()
    for k, (reason, detail) in enumerate(images):
        state.add(refused_image(k, 640, 512, reason, detail))
    assert state.disk_free_bytes() is None
    message = state.solve().message
    assert message.startswith('too few observations') and ('refused' in message) == bool(words)
    assert words in message and '\n' not in message and not message.endswith(': ')


def test_the_first_of_a_stamp_stands_in_memory_and_on_disk(tmp_path) -> None:
    other = dataclasses.replace(observations()[1], time_ns=observations()[0].time_ns)
    before = filled((*observations()[:2], other), tmp_path)
    before.add(dataclasses.replace(other, time_ns=1, width=8))
    before.close()
    after = started(tmp_path)
    after.add(other)
    for state in (before, after):
        stars = [image.catalog_id.tolist() for image in state.ensemble.images]
        assert stars == [image.catalog_id.tolist() for image in observations()[:2]]
    assert dict(before.ensemble.refused) == {'duplicate': 1, 'wrong_size': 1}
    assert dict(after.ensemble.refused) == {'duplicate': 2, 'wrong_size': 1}
    after.close()


def test_a_full_disk_costs_nothing_that_memory_holds(tmp_path) -> None:
    state, told = filled(observations()[:-1], tmp_path), list[str]()
    state._on_trouble = told.append
    with full_disk():
        state.add(observations()[-1])
        answer = state.solve()
        status = state.status()
    assert answer.success and answer.message.startswith('not on disk: state_dir:')
    assert told[0].startswith('state_dir:') and told[-1] == state.trouble
    assert (status.images, status.images_saved) == (len(observations()), len(observations()) - 1)
    assert 'cannot be written: File too large' in state.trouble
    assert (state.disk_free_bytes() or 0) > 0
    # The folder is let go of and taken up again before the disk has room: nothing is lost.
    state.close()
    state.open(bag_setup(), CalibratorOptions(state_dir=str(tmp_path)))
    assert state.trouble == told[-1] == '' and '' not in told[:-1]
    assert state.status().images_saved == len(observations())
    state.close()
    state = started(tmp_path)
    assert len(state.ensemble.images) == len(observations()) and state.active is not None
    state.close()


def test_a_removed_folder_is_noticed_without_an_image(tmp_path) -> None:
    state = filled(observations()[:1], tmp_path / 'A')
    assert not state.is_unsaved
    shutil.rmtree(tmp_path / 'A')
    assert state.is_unsaved and state.status().images_saved == 0
    state.save()
    assert 'was removed or replaced' in state.trouble
    state.close()


def test_an_image_that_comes_with_a_restart_is_added_on_disk(tmp_path, monkeypatch) -> None:
    """They would be taken for those of a reset, and removed."""
    add, state = solving.add_to_ensemble, filled(observations()[:3], tmp_path)

    def long_add(*arguments: Any) -> Any:
        monkeypatch.undo()
        state.close()
        state.open(bag_setup(), CalibratorOptions(state_dir=str(tmp_path)))
        return add(*arguments)

    monkeypatch.setattr(solving, 'add_to_ensemble', long_add)
    state.add(observations()[3])
    state.close()
    state = started(tmp_path)
    shown, kept = observations()[:4], state.ensemble.images
    assert [image.time_ns for image in kept] == [image.time_ns for image in shown]
    state.close()


def test_a_folder_of_another_camera_is_refused(tmp_path) -> None:
    filled(observations()[:1], tmp_path / 'state').close()
    prior = bag_setup().prior
    wider = dataclasses.replace(prior, camera=dataclasses.replace(prior.camera, width=1280))
    other = dataclasses.replace(bag_setup(), prior=wider)
    with pytest.raises(OptionError, match=f'state_dir: {tmp_path / "state"} is of a camera of'):
        started(tmp_path / 'state', other)
    started(tmp_path / 'state').close()  # it was let go of


@pytest.mark.parametrize('step', ['images 0', 'activate a'])
@pytest.mark.parametrize('frames', ['navcam_2 star_tracker', 'camera star_tracker_2'])
def test_a_folder_of_other_frames_is_refused_and_stays(calibrators, step, frames) -> None:
    """By a process that holds nothing too, whose calibration would be that of another camera."""
    calibrators.run(f'open A; {step}; kill')
    content = {path: path.read_bytes() for path in calibrators.disk.glob('A/*/*')}
    given = frames.replace(' ', ' in ')
    words = f'camera in star_tracker, the parameters of camera_frame {given}:'
    with pytest.raises(OptionError, match=words):
        calibrators.run(f'camera {frames}; open A')
    assert content == {path: path.read_bytes() for path in calibrators.disk.glob('A/*/*')} != {}
    calibrators.run('camera camera; open A')


def test_one_calibration_of_other_frames_is_not_active(calibrators) -> None:
    calibrators.run('open A; activate a; activate b; kill')
    (path,) = calibrators.disk.glob('A/calibrations/*2.json')
    content = CHECKSUMS.opened(path.read_bytes())
    of_other = {**content, 'alignment': {**content['alignment'], 'child': 'other'}}
    path.write_text(CHECKSUMS.sealed(of_other))
    state = calibrators.run('open A')
    assert 'it is of other in star_tracker, the parameters of camera in' in state.withheld[2]
    assert state.active is not None and state.active.weakest_direction == 'a'


@pytest.mark.slow
def test_a_forged_verdict_does_not_go_past_a_rolled_back_one(tmp_path) -> None:
    """Event 3 went back from 2 to 1: where 1 is refused, 2 must not come up again."""
    state = filled(observations(), tmp_path)
    assert state.solve().success and state.solve().success and state.rollback().success
    state.close()
    for path in (tmp_path / 'calibrations').glob('*_calibration_00000001.json'):
        content = CHECKSUMS.opened(path.read_bytes())
        path.write_text(CHECKSUMS.sealed({**content, 'accepted': False, 'reasons': ['forged']}))
    state = started(tmp_path)
    assert state.active is None
    assert 'its file states that the gate refused it; forged' in state.withheld[1]
    state.close()


def test_reasons_that_a_sender_makes_up_are_one(tmp_path) -> None:
    state = started(tmp_path)
    for k in range(50):
        state.add(refused_image(k, 640, 512, f'reason {k}', ''))
    assert dict(state.ensemble.refused) == {'other': 50}
    counts = tmp_path / 'ensemble' / 'refused.json'
    assert not counts.exists()  # fifty refused images are no fifty writes
    state.close()
    assert counts.stat().st_size < 300
    state = started(tmp_path)
    assert dict(state.ensemble.refused) == {'other': 50}
    state.close()


def test_a_reset_keeps_what_was_set_aside(tmp_path) -> None:
    filled(observations()[:2], tmp_path).close()
    victim = tmp_path / 'ensemble' / '00000002.mcap'
    victim.write_bytes(victim.read_bytes()[:-100])
    (tmp_path / 'ensemble' / 'notes.txt').write_text('mine')
    state = started(tmp_path)
    state.reset()
    state.close()
    left = sorted(path.name for path in (tmp_path / 'ensemble').iterdir())
    assert left == ['00000002.mcap.damaged', 'notes.txt', 'refused.json']


def test_one_image_of_another_size_is_set_aside(tmp_path) -> None:
    other = dataclasses.replace(observations()[2], width=1280)
    with contextlib.closing(Archive(tmp_path, 'camera')) as archive:
        archive.keep(Ensemble((*observations()[:2], other)), ())
    state = started(tmp_path)
    assert len(state.ensemble.images) == 2
    assert '00000003.mcap.damaged' in state.damage[0] and 'an image of 1280 x' in state.damage[0]
    state.close()


# Which calibration is active after steps | words of the answer to the last request.  A candidate
# moves the corners by so many px; the limit is 0.3 px, 1.5 px from the prior.
ACTIVATIONS = scripts(rf"""
# Another request changes the active calibration during the solve.
refused against 1 after a roll-back -> a | refused by the gate: largest change
    activate a; activate b 0.25; solve c 0.5 while rollback
of a roll-back that makes it acceptable -> d | activated:
    activate a; activate b 0.25; activate c 0.5; solve d 0.1 while rollback
by force after a roll-back -> c | activated:
    activate a; activate b 0.25; solve c 0.5 force while rollback
# Roll-backs past calibrations that were forced, withheld or are refused by the gate today.
past a forced one -> a | activated again:
    activate a; activate b 2 force; rollback
to a forced one -> b | activated again:
    activate a 0.25; activate b 2 force; activate c 2.25 force; rollback
past a forced one that came while others were withheld -> a | activated again:
    activate a 0.2; limit 0.01; open A; activate b 0.25 force; limit 0.3; open A; rollback
forced dry run -> a | would be activated:
    activate a; solve b 2 dry_run force
a forced one that misses another requirement -> none | no calibration is active
    require f=1e-6px; open A; activate a 0 force; require map=1e-6px; open A; rollback
past one refused today -> b | calibration 3 is not active, the gate refuses it now: largest change
    activate a; activate b 0.2; activate c 0.45; activate d 0.3; limit .08; open A; rollback
to none but refused -> b | calibration 1 is not active, the gate refuses it now: largest change
    activate a 0.5; activate b 0.25; limit 0.08; open A; rollback
from one that a roll-back made active before a restart -> a | activated again:
    activate a; activate b .1; activate c .2; rollback; kill; open A; rollback
to one that was active when the active one came -> a | activated again:
    activate a; activate b .1; activate c .2; rollback; rollback; activate d .1; rollback
to none -> a | there is no calibration before the active one
    activate a; rollback
# The limits change, and with them what is active.
withheld -> none | no calibration is active
    activate a 0.25; limit 0.01; open A; rollback
withheld with another mounting -> none | no calibration is active
    activate a; turn 90; open A; rollback
withheld in memory -> none | no calibration is active
    open -; activate a 0.25; limit 0.01; open -; rollback
relaxed again -> a | refused by the gate: largest change
    activate a 0.25; limit 0.01; open A; limit 0.3; open A; solve b 2
during a solve -> a | not activated: the node was cleaned up meanwhile
    activate a; limit 0.2; solve b 0 while open A
# The answer has the requirements.
met -> a | activated: .* arcsec, at most 1000 arcsec required: met
    require line_of_sight=1000arcsec@98%; open A; solve a
missed -> none | over the limit of 0.000001 px \(requirements\); missed by
    require f=1e-6px; open A; solve a
# A clock that no stamp holds: nothing is written that its reader sets aside.
before 1970 -> a | not activated, nobody could read
    activate a; clock -1; solve b
after 2038 -> a | active_since_ns: {MAX_STAMP_NS + 1} .*; check the ROS clock
    activate a; clock {MAX_STAMP_NS + 1}; solve b
no /clock yet -> a | not activated: the ROS clock is 0
    activate a; clock 0; solve b
1970 -> b | activated:
    activate a; clock 1; solve b
2038 -> b | activated:
    activate a; clock {MAX_STAMP_NS}; solve b
""")


@pytest.mark.slow
@pytest.mark.parametrize('name', ACTIVATIONS)
def test_what_is_activated_passes_the_gate_of_that_moment(name, calibrators) -> None:
    """The answer says what is active; so do a restarted node and readers of the folder."""
    steps, active, words = ACTIVATIONS[name]
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
        if active:
            assert read_calibration(calibrators.disk / 'A').weakest_direction == active
        else:
            with pytest.raises(ProductError, match='no calibration is active|holds no calib'):
                read_calibration(calibrators.disk / 'A')


def test_a_folder_states_what_is_active_and_why_others_are_not(calibrators) -> None:
    calibrators.run('limit 0.3; open A; activate a 0.25; activate b 0.2; rollback')
    folder = calibrators.disk / 'A'
    first, last = 'calibration 1 is not active', 'calibration 2 is not active'
    rolled_back = f'{last}, ~/rollback returned to an earlier one'
    stated = json.loads((folder / 'active.json').read_text())
    assert stated['active'] == 'calibrations/00000003_calibration_00000001.json'
    assert (stated['events'], stated['withdrawn']) == (3, [rolled_back])
    # A kill before the file was written: the event that it does not count is active.
    (folder / 'active.json').write_text(json.dumps({**stated, 'events': 2, 'active': ''}))
    assert read_calibration(folder).weakest_direction == 'a'
    calibrators.run('limit 0.01; open A')
    stated = json.loads((folder / 'active.json').read_text())
    refused, *others = stated['withdrawn']
    assert stated['active'] == '' and others == [rolled_back]
    assert refused.startswith(f'{first}, the gate refuses it now: largest change')
    with pytest.raises(ProductError, match=f'no calibration is active; {first}, the gate'):
        read_calibration(folder)


@pytest.mark.slow
def test_history_is_bounded(calibrators, monkeypatch) -> None:
    monkeypatch.setattr('starcal_ros.ros.state.HISTORY', 2)
    calibrators.run('open A; activate a; activate b; activate c')
    assert len(list((calibrators.disk / 'A' / 'calibrations').iterdir())) == 2
    state = calibrators.run('rollback; rollback')
    gone = 'there is no calibration before the active one on record'
    assert calibrators.answer.message == gone
    assert state.active is not None and state.active.weakest_direction == 'b'
