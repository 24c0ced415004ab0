# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibrator keeps: in memory, on disk, across restarts, and what it answers."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from pathlib import Path
from typing import Any

from kept_state import full_disk  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ground.products import write_camera_info
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.errors import OptionError
from starcal_ros.pipeline import solve as solving
from starcal_ros.pipeline.setup import CalibratorOptions, load_setup, Setup
from starcal_ros.records import CameraGeometry, Ensemble, refused_image, StarObservations
from starcal_ros.ros.archive import Archive, CHECKSUMS
from starcal_ros.ros.state import Answer, CalibratorState

SCENARIO = scenario('tiny', seed=7)


@pytest.fixture(scope='module')
def shown() -> tuple[StarObservations, ...]:
    return true_observations(SCENARIO).images


def load(folder: Path, scenario_name: str = 'tiny', **values: object) -> Setup:
    prior = scenario(scenario_name, seed=7).prior
    write_camera_info(prior.camera, folder / f'{scenario_name}.yaml')
    return load_setup(
        {
            'camera_info_url': str(folder / f'{scenario_name}.yaml'),
            'prior_alignment': prior.star_tracker_from_camera_xyzw.tolist(),
            **values,
        }
    )


@pytest.fixture(scope='module')
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return load(tmp_path_factory.mktemp('setup'))


def started(setup: Setup, folder: Path | str = '') -> CalibratorState:
    state = CalibratorState(itertools.count(1).__next__)
    state.open(setup, CalibratorOptions(state_dir=str(folder)))
    return state


def filled(
    setup: Setup, shown: tuple[StarObservations, ...], folder: Path | str = ''
) -> CalibratorState:
    state = started(setup, folder)
    for image in shown:
        state.add(image)
    return state


@pytest.mark.slow
def test_a_restart_goes_on_where_it_stood(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    """The same solution to the last bit, and the same active calibration."""
    first = filled(setup, shown, tmp_path)
    first.add(refused_image(5, 8, 8, 'no_stars', ''))
    answer = first.solve()
    assert answer.success and answer.active and answer.calibration is not None
    assert (answer.calibration.number, answer.calibration.active_since_ns) == (1, 1)
    status = first.status()
    assert status.images == status.images_saved == len(shown)
    first.close()
    second = started(setup, tmp_path)
    assert dict(second.status().refused) == {'no_stars': 1}
    active, again = second.active, second.solve().calibration
    assert active is not None and again is not None
    for found in (active, again):
        assert found.covariance.tobytes() == answer.calibration.covariance.tobytes()
        assert found.provenance == answer.calibration.provenance
    assert (active.number, again.number) == (1, 2)
    second.close()


@pytest.mark.slow
def test_history_is_bounded(
    setup: Setup,
    shown: tuple[StarObservations, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('starcal_ros.ros.state.HISTORY', 2)
    state = started(setup, tmp_path)
    for image in shown:
        state.add(image)
    for _ in range(4):
        assert state.solve().success
    assert len(list((tmp_path / 'calibrations').iterdir())) == 2
    assert state.rollback().success
    gone = state.rollback()
    assert gone.message == 'there is no calibration before the active one on record'
    state.close()


@pytest.mark.slow
def test_the_time_of_an_activation_is_read_when_it_is_made(
    setup: Setup, shown: tuple[StarObservations, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A roll-back during a solve is the earlier activation, and its time the earlier one."""
    state = filled(setup, shown)
    assert state.solve().success and state.solve().success
    solve, times = solving.solve, []

    def long_solve(*arguments: Any, **options: Any) -> Any:
        solved = solve(*arguments, **options)
        back = state.rollback()
        assert back.calibration is not None
        times.append(back.calibration.active_since_ns)
        return solved

    monkeypatch.setattr(solving, 'solve', long_solve)
    answer = state.solve()
    assert answer.calibration is not None and answer.calibration is state.active
    assert times[0] < answer.calibration.active_since_ns


@pytest.mark.slow
@pytest.mark.parametrize(
    ('requirement', 'words'),
    [
        ('line_of_sight=1000arcsec@98%', 'arcsec, at most 1000 arcsec required: met'),
        ('f=1e-6px', 'over the limit of 0.000001 px (requirements); missed by'),
    ],
)
def test_the_answer_has_the_requirements(
    setup: Setup, shown: tuple[StarObservations, ...], requirement: str, words: str
) -> None:
    gate = dataclasses.replace(setup.gate, requirements=(requirement,))
    answer = filled(dataclasses.replace(setup, gate=gate), shown).solve()
    assert words in answer.message and answer.success == words.endswith('met')


@pytest.mark.slow
def test_what_is_forced_says_so_and_stays_for_its_own_reasons_only(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    gate = dataclasses.replace(setup.gate, max_change_px=1e-6)
    given = dataclasses.replace(setup, gate=gate)
    state = filled(given, shown, tmp_path)
    refused = state.solve()
    assert not refused.success and refused.calibration is not None
    assert (refused.calibration.number, refused.calibration.forced) == (0, False)
    assert state.active is None
    assert state.solve(dry_run=True, force=True).success and state.active is None
    assert state.solve(force=True).success
    state.close()
    for again in (given, setup):
        state = started(again, tmp_path)
        active = state.active
        assert active is not None and active.forced and not active.accepted
        assert active.reasons[-1] == 'activated by request despite the gate'
        state.close()
    tighter = dataclasses.replace(gate, requirements=('map=1e-6px',))
    state = started(dataclasses.replace(setup, gate=tighter), tmp_path)
    assert state.active is None and 'requirements' in state.withheld[0]
    assert 'max_change_px' not in state.withheld[0]
    state.close()


# Refused images, and what the answer of a request says of them.
REFUSED = {
    'none': ([], '', False),
    'cause': (
        [('no_match', '23 star-like sources'), ('no_match', 'The images are mirrored.')],
        '; 2 images refused as no_match: The images are mirrored; ask starcal diagnose, or',
        True,
    ),
    'most': (
        [('glare', ''), ('glare', ''), ('no_stars', '1 source')],
        '; 2 images refused as glare: ',
        True,
    ),
    'dropped': ([('wrong_size', '')] * 2, '; 2 images refused as wrong_size: ', True),
}


@pytest.mark.parametrize('name', REFUSED)
def test_a_request_without_images_is_answered_with_the_cause(setup: Setup, name: str) -> None:
    images, words, expected = REFUSED[name]
    state = started(setup)
    for k, (reason, detail) in enumerate(images):
        state.add(refused_image(k, 640, 512, reason, detail))
    message = state.solve().message
    assert message.startswith('too few observations') and ('refused' in message) is expected
    assert words in message and '\n' not in message and not message.endswith(': ')


def test_what_would_count_twice_or_wrong_is_refused(
    setup: Setup, shown: tuple[StarObservations, ...]
) -> None:
    state = filled(setup, (*shown, shown[0]))
    state.add(dataclasses.replace(shown[0], time_ns=1, width=8))
    status = state.status()
    assert status.images == len(shown) and status.images_saved == 0
    assert dict(status.refused) == {'duplicate': 1, 'wrong_size': 1}


def test_the_first_of_a_stamp_stands_in_memory_and_on_disk(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    other = dataclasses.replace(shown[1], time_ns=shown[0].time_ns)
    before = filled(setup, (*shown[:2], other), tmp_path)
    before.close()
    after = started(setup, tmp_path)
    after.add(other)
    for state in (before, after):
        stars = [image.catalog_id.tolist() for image in state.ensemble.images]
        assert stars == [image.catalog_id.tolist() for image in shown[:2]]
    assert dict(before.ensemble.refused) == {'duplicate': 1}
    assert dict(after.ensemble.refused) == {'duplicate': 2}
    after.close()


def test_a_full_disk_costs_nothing_that_memory_holds(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    state = filled(setup, shown[:-1], tmp_path)
    with full_disk():
        state.add(shown[-1])
        answer = state.solve()
        status = state.status()
    assert answer.success and 'not on disk: state_dir:' in answer.message
    assert (status.images, status.images_saved) == (len(shown), len(shown) - 1)
    assert 'cannot be written: File too large' in state.trouble
    # The folder is let go of and taken up again before the disk has room: nothing is lost.
    state.close()
    state.open(setup, CalibratorOptions(state_dir=str(tmp_path)))
    assert state.trouble == '' and state.status().images_saved == len(shown)
    state.close()
    state = started(setup, tmp_path)
    assert len(state.ensemble.images) == len(shown) and state.active is not None
    state.close()


@pytest.mark.slow
def test_a_reset_that_no_disk_took_outlasts_a_clean_up(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    """Images cannot be removed until the node is configured again."""
    options, state = CalibratorOptions(state_dir=str(tmp_path)), filled(setup, shown, tmp_path)
    assert state.solve().success
    in_the_way = tmp_path / 'ensemble.emptied'
    in_the_way.touch()
    assert 'not on disk' in state.reset().message
    state.close()
    in_the_way.unlink()
    state.open(setup, options)
    assert state.trouble == '' and not state.ensemble.images
    state.close()
    state = started(setup, tmp_path)
    active = state.active
    assert active is not None and active.number == 1 and not state.ensemble.images
    state.close()


@pytest.mark.slow
@pytest.mark.parametrize('on_disk', [False, True])
def test_a_solution_is_active_only_under_the_limits_that_judged_it(
    setup: Setup,
    shown: tuple[StarObservations, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    on_disk: bool,
) -> None:
    """The node is cleaned up and configured with tighter limits while it solves."""
    solve, options = solving.solve, CalibratorOptions(state_dir=str(tmp_path) if on_disk else '')
    state = filled(setup, shown, options.state_dir)
    tighter = dataclasses.replace(setup.gate, max_change_px=1e-6)

    def long_solve(*arguments: Any, **given: Any) -> Any:
        solved = solve(*arguments, **given)
        state.close()
        state.open(dataclasses.replace(setup, gate=tighter), options)
        return solved

    monkeypatch.setattr(solving, 'solve', long_solve)
    assert state.solve() == Answer(False, 'not activated: the node was cleaned up meanwhile')
    assert state.active is None
    state.close()


def test_an_image_that_comes_with_a_restart_is_added_to_those_on_disk(
    setup: Setup,
    shown: tuple[StarObservations, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They would be taken for those of a reset, and removed."""
    add, state = solving.add_to_ensemble, filled(setup, shown[:3], tmp_path)

    def long_add(*arguments: Any) -> Any:
        monkeypatch.undo()
        state.close()
        state.open(setup, CalibratorOptions(state_dir=str(tmp_path)))
        return add(*arguments)

    monkeypatch.setattr(solving, 'add_to_ensemble', long_add)
    state.add(shown[3])
    state.close()
    state = started(setup, tmp_path)
    assert [image.time_ns for image in state.ensemble.images] == [i.time_ns for i in shown[:4]]
    state.close()


def test_a_folder_of_another_camera_is_refused(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    filled(setup, shown[:1], tmp_path / 'state').close()
    other = load(tmp_path, 'small')
    with pytest.raises(OptionError, match=f'state_dir: {tmp_path / "state"} is of a camera of'):
        started(other, tmp_path / 'state')
    started(setup, tmp_path / 'state').close()  # it was let go of


def test_memory_alone(setup: Setup, shown: tuple[StarObservations, ...]) -> None:
    state = started(setup)
    assert state.rollback() == Answer(False, 'no calibration is active')
    assert 'too few observations' in state.solve().message
    assert state.ensemble == Ensemble() and state.disk_free_bytes() is None
    for image in shown:
        state.add(image)
    assert state.solve().success
    state.close()
    state.open(setup, CalibratorOptions())
    active = state.active
    assert active is not None and np.isfinite(active.covariance).all()


@pytest.mark.slow
def test_the_gate_of_today_judges_what_was_stored(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    """With another prior or limit it is not active, stays on disk, and comes back with them."""
    state = filled(setup, shown, tmp_path)
    first, second = state.solve().calibration, state.solve().calibration
    assert first is not None and second is not None
    state.close()
    kept = sorted((tmp_path / 'calibrations').iterdir())
    camera = setup.prior.camera.replace(fx=2400.0, fy=2400.0)
    turned = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    tighter = dataclasses.replace(setup.gate, max_change_px=1e-6)
    for changed, option in (
        (dataclasses.replace(setup, prior=dataclasses.replace(setup.prior, camera=camera)),
         'max_change_px'),
        (dataclasses.replace(setup, prior=CameraGeometry(setup.prior.camera, turned)),
         'max_rotation_deg'),
        (dataclasses.replace(setup, gate=tighter), 'max_change_px'),
    ):  # fmt: skip
        state = started(changed, tmp_path)
        assert state.active is None
        assert len(state.withheld) == 2 and all(option in text for text in state.withheld)
        assert state.rollback() == Answer(False, 'no calibration is active')
        assert state.damage == ()
        state.close()
        assert sorted((tmp_path / 'calibrations').iterdir()) == kept
    state = started(setup, tmp_path)
    assert state.withheld == () and state.active is not None and state.active.number == 2
    state.close()


def test_the_gate_judges_what_is_in_memory_alone(
    setup: Setup, shown: tuple[StarObservations, ...]
) -> None:
    """Cleaned up, configured with a tighter limit, and back."""
    state = filled(setup, shown)
    assert state.solve().success
    state.close()
    tighter = dataclasses.replace(setup.gate, max_change_px=1e-6)
    state.open(dataclasses.replace(setup, gate=tighter), CalibratorOptions())
    assert state.active is None and len(state.withheld) == 1
    state.open(setup, CalibratorOptions())
    assert state.active is not None and state.withheld == ()


@pytest.mark.slow
def test_a_forged_verdict_does_not_go_past_a_rolled_back_one(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    """Event 3 went back from 2 to 1: where 1 is refused, 2 must not come up again."""
    state = filled(setup, shown, tmp_path)
    assert state.solve().success and state.solve().success and state.rollback().success
    state.close()
    for path in (tmp_path / 'calibrations').glob('*_calibration_00000001.json'):
        content = CHECKSUMS.opened(path.read_bytes())
        path.write_text(CHECKSUMS.sealed({**content, 'accepted': False, 'reasons': ['forged']}))
    state = started(setup, tmp_path)
    assert state.active is None
    assert 'its file states that the gate refused it; forged' in state.withheld[0]
    state.close()


def test_reasons_that_a_sender_makes_up_are_one(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    state = started(setup, tmp_path)
    for k in range(50):
        state.add(refused_image(k, 640, 512, f'reason {k}', ''))
    assert dict(state.ensemble.refused) == {'other': 50}
    counts = tmp_path / 'ensemble' / 'refused.json'
    assert not counts.exists()  # fifty refused images are no fifty writes
    state.close()
    assert counts.stat().st_size < 300
    state = started(setup, tmp_path)
    assert dict(state.ensemble.refused) == {'other': 50}
    state.close()


def test_a_reset_keeps_what_was_set_aside(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    filled(setup, shown[:2], tmp_path).close()
    victim = tmp_path / 'ensemble' / '00000002.mcap'
    victim.write_bytes(victim.read_bytes()[:-100])
    (tmp_path / 'ensemble' / 'notes.txt').write_text('mine')
    state = started(setup, tmp_path)
    state.reset()
    state.close()
    left = sorted(path.name for path in (tmp_path / 'ensemble').iterdir())
    assert left == ['00000002.mcap.damaged', 'notes.txt', 'refused.json']


def test_one_image_of_another_size_is_set_aside(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    other = dataclasses.replace(shown[2], width=1280)
    with contextlib.closing(Archive(tmp_path, 'camera')) as archive:
        archive.keep(Ensemble((*shown[:2], other)), ())
    state = started(setup, tmp_path)
    assert len(state.ensemble.images) == 2
    assert '00000003.mcap.damaged' in state.damage[0] and 'an image of 1280 x' in state.damage[0]
    state.close()


def test_without_the_key_nothing_is_believed(
    setup: Setup, shown: tuple[StarObservations, ...], tmp_path: Path
) -> None:
    key = tmp_path / 'key'
    key.write_bytes(b'sixteen bytes...')
    filled(setup, shown[:2], tmp_path / 'state').close()
    state = filled(setup, shown[2:3])
    state.open(setup, CalibratorOptions(str(tmp_path / 'other'), state_key_file=str(key)))
    state.close()
    for path in (tmp_path / 'state' / 'ensemble').glob('*.mcap'):
        path.rename(tmp_path / 'other' / 'ensemble' / f'0000000{int(path.stem) + 1}.mcap')
    state = CalibratorState(itertools.count(1).__next__)
    state.open(setup, CalibratorOptions(str(tmp_path / 'other'), state_key_file=str(key)))
    assert [image.time_ns for image in state.ensemble.images] == [shown[2].time_ns]
    assert all('the HMAC is missing' in text for text in state.damage) and len(state.damage) == 2
    state.close()
