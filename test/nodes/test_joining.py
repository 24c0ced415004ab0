# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Memory and state folders joined: what is kept, what is active, and what cannot be joined."""

from collections.abc import Iterator
import dataclasses
import itertools
from pathlib import Path
from random import Random
from typing import Any

from attacks import observations  # type: ignore[import-not-found]
from calibrators import kept, scripts  # type: ignore[import-not-found]
from kept_state import activation  # type: ignore[import-not-found]
import pytest

from starcal_ros.errors import StarcalError
from starcal_ros.formats.products.product_files import STATE_ACTIVE, write_atomically
from starcal_ros.records import Activation
from starcal_ros.ros.joining import joined, Kept

pytestmark = pytest.mark.slow


# What P1 holds after steps: images | calibrations, from the active one back in time.
JOINS = scripts("""
# A disk fails, and another one takes its place.
full A, B -> 0 1 2 | a
    open A; full; images 0 1 2; activate a; close; room; open B
full A, full B -> 0 1 | a
    open A; full; images 0 1; activate a; open B; room
A, full A, A -> 0 1 | b a
    open A; images 0; activate a; full; images 1; activate b; close; room; open A
A, full A, memory, B -> 0 1 2 | a
    open A; images 0; full; images 1; activate a; open -; images 2; room; open B
# With and without a folder.
memory, A -> 0 1 | m
    open -; images 0 1; activate m; open A
A, memory, A -> 0 1 | m a
    open A; images 0; activate a; open -; images 1; activate m; open A
A, B, A -> 0 1 2 | b a
    open A; images 0; activate a; open B; images 1; activate b; open A; images 2
# A folder with records of its own: the later activation is active.
earlier A and memory -> 0 1 2 | m a
    P2 open A; P2 images 0 1; P2 activate a; P2 close; open -; images 1 2; activate m; open A
later A and memory -> 1 2 0 | a m
    open -; images 0 1; activate m; P2 open A; P2 images 1 2; P2 activate a; P2 close; open A
between the events of A -> none | a
    P2 open A; P2 activate a; open -; activate m; P2 activate b; P2 rollback; P2 close; open A
A between the events of memory -> none | n m
    open -; activate m; P2 open A; P2 activate a; P2 close; activate n; open A
a copy of A -> 0 1 2 | b a
    open A; images 0 1; activate a; activate b; close; copy A B; open B; images 2; open A
A and its copy went on -> 0 1 2 | c a
    P2 open A; P2 images 0; P2 activate a; P2 close; copy A B; P2 open A; P2 images 1;
    P2 activate b; P2 close; open B; images 2; activate c; open A
# Files of the folder are gone or damaged: the memory has their records.
damaged image -> 1 0 | none
    open A; images 0 1; close; cut A/ensemble/*1.mcap; open A
damaged event -> none | b a
    open A; activate a; activate b; close; cut A/calibrations/*2.json; open A
removed folder -> 0 1 | a
    open A; images 0 1; activate a; close; remove A; open A
folder removed in use -> 0 1 | b a
    open A; images 0; activate a; remove A; images 1; activate b; open A
reset -> 3 | none
    open A; images 0 1; reset; images 3
# A reset is an event of the images: they do not come back from anywhere.
reset on full A, A -> 2 | a
    open A; images 0 1; activate a; full; reset; images 2; close; room; open A
reset on full A, B -> 2 | none
    open A; images 0 1; full; reset; images 2; room; open B
reset on A that cannot be emptied, A -> 2 | a
    open A; images 0 1; activate a; touch A/ensemble.emptied; reset; images 2; close;
    remove A/ensemble.emptied; open A
reset in B, A -> none | none
    open A; images 0 1; open B; reset; open A
reset in B, restart, B, A -> none | none
    open A; images 0 1; open B; reset; kill; open B; open A
reset in memory, B of another -> 0 1 3 | none
    P2 open B; P2 images 0 1; P2 close; open -; images 2; reset; images 3; open B
reset of A by another -> 2 | none
    open A; images 0 1; close; P2 open A; P2 reset; P2 images 2; P2 close; open A
images of a reset come again -> 1 0 2 | none
    open A; images 0 1; full; reset; images 1 0 2; close; room; open A
images of a reset come again to A -> 0 | none
    open A; images 0 1; open B; reset; P2 open A; P2 reset; P2 images 0; P2 close; open A
""")


@pytest.mark.parametrize('name', JOINS)
def test_nothing_is_dropped_but_by_a_reset(name, calibrators) -> None:
    """It is so in memory, and after a restart from the folder alone."""
    steps, images, names = JOINS[name]
    state = calibrators.run(steps)
    folder = steps.split('open ')[-1].split(';')[0]
    state.save()
    assert state.trouble == ''
    calibrators.run(f'kill; open {folder}')
    assert kept(calibrators.states['P1']) == (images, names)
    numbers = [record.calibration.number for record in calibrators.states['P1']._history]
    of_name = {r.calibration.weakest_direction: r.calibration.number for r in state._history}
    assert set(numbers) == set(of_name.values())  # two calibrations never have one number


@pytest.mark.parametrize('differs', ['measured_px', 'catalog_id'])
def test_another_image_of_a_stamp_is_counted(calibrators, differs: str) -> None:
    """The image of the folder stays, as the first of a stamp does, and counts of both are kept."""
    state = calibrators.run('P2 open A; P2 images 0 1; P2 close; open -; images 2')
    first = observations()[0]
    state.add(dataclasses.replace(first, **{differs: 2 * getattr(first, differs)}))
    for refusal in ('glare', 'no_stars'):
        state.add(dataclasses.replace(first, refusal=refusal))
    calibrators.run('P2 open A')
    calibrators.states['P2'].add(dataclasses.replace(first, refusal='glare'))
    calibrators.run('P2 close; open A; open -; open A')
    assert kept(state) == ('0 1 2', '')
    assert state.ensemble.images[0].measured_px.tolist() == first.measured_px.tolist()
    assert dict(state.ensemble.refused) == {'duplicate': 1, 'glare': 2, 'no_stars': 1}


def test_the_limit_of_images_holds(calibrators) -> None:
    few = dataclasses.replace(calibrators.setup.calibration, max_images=4)
    calibrators.setup = dataclasses.replace(calibrators.setup, calibration=few)
    state = calibrators.run('P2 open A; P2 images 0 1 2 3; P2 close; open -; images 4 5 6; open A')
    assert len(state.ensemble.images) == state.status().images_saved == 4
    assert len(list((calibrators.disk / 'A' / 'ensemble').glob('*.mcap'))) == 4


# How the last step fails; before it, P1 holds images 0 and 1 and calibration m.
UNJOINED = scripts(r"""
of another camera -> 2 images and 1 activation are of .*, camera in star_tracker, and not on disk:
    open -; images 0 1; activate m; camera navcam_2; open A
not saved of another -> and not on disk: configure with that camera and a state_dir that can be
    open A; images 0; full; images 1; activate m; close; room; camera navcam_2; open -
a folder of another -> A is of camera_frame navcam_1 in star_tracker, the parameters of camera_fr
    camera navcam_1; P2 open A; P2 images 2; P2 close; camera camera;
    open -; images 0 1; activate m; open A
in use -> in use by another calibrator
    P2 open A; open -; images 0 1; activate m; open A
another key -> no file of .*A has an HMAC of state_key_file, but 2 are sound: give the key
    P2 open A; P2 images 2; P2 activate a; P2 close; open -; images 0 1; activate m; open A key
""")


@pytest.mark.parametrize('name', UNJOINED)
def test_what_cannot_be_joined_stops_the_transition(name, calibrators) -> None:
    """One sentence with the remedy; memory and folder are as before."""
    steps, words = UNJOINED[name]
    before, _, last = steps.rpartition('; ')
    state = calibrators.run(before)
    files = sorted(path.name for path in calibrators.disk.glob('A/*/*'))
    with pytest.raises(StarcalError, match=words) as error:
        calibrators.run(last)
    assert len(str(error.value).replace(str(calibrators.disk), '')) < 300
    assert sorted(path.name for path in calibrators.disk.glob('A/*/*')) == files
    calibrators.run('camera camera; open B')
    assert kept(state) == ('0 1', 'm')


def test_a_camera_that_is_on_disk_makes_place_for_another(calibrators) -> None:
    """Its records stay in its folder, and are not mixed with those of the other."""
    state = calibrators.run('open A; images 0 1; activate a; camera navcam_2; open B')
    assert str(state).endswith(f'they stay in {calibrators.disk / "A"}')
    assert kept(state) == ('', '')
    calibrators.run('images 2; close; camera camera; open A')
    assert kept(state) == ('0 1', 'a')


def test_a_disk_that_fails_at_any_write_of_a_join(calibrators, monkeypatch) -> None:
    """Nothing of the folder is lost, and the later activation of those on disk is active."""
    calibrators.run('open A; images 0 1; activate a; kill')
    for writes in itertools.count():
        left = itertools.chain([None] * writes, itertools.repeat(OSError(5, 'broken')))
        failed: set[str] = set()

        def fails_then(
            path: Path, data: str | bytes, left: Iterator[Any] = left, failed: set[str] = failed
        ) -> None:
            if error := next(left):
                failed.add(path.name)
                raise error
            write_atomically(path, data)

        place = f'copy{writes}'
        # The event of the memory comes between those of the folder, and takes their numbers.
        calibrators.run(f'copy A {place}; open -; images 2; activate m')
        calibrators.run(f'P2 open {place}; P2 images 3; P2 activate c; P2 kill')
        with monkeypatch.context() as patch:
            patch.setattr('starcal_ros.ros.archive.write_atomically', fails_then)
            is_whole = calibrators.run(f'open {place}').trouble == ''
            assert is_whole == (not failed)
            calibrators.run('kill')
        state = calibrators.run(f'open {place}')
        history = [record.calibration.weakest_direction for record in state._history]
        # The last write only states which calibration is active.
        is_joined = failed <= {STATE_ACTIVE}
        assert kept(state) == ('0 1 3 2' if is_joined else '0 1 3', 'c a')
        calibrators.run('kill')
        if is_whole:
            assert history == ['a', 'm', 'c']
            break
    assert writes >= 3  # two events, the collections and an image


def grown(
    history: tuple[Activation, ...], random: Random, clock: list[int]
) -> tuple[Activation, ...]:
    """A history with some more activations and roll-backs, by a clock that may be set back."""
    for _ in range(random.randrange(5)):
        clock[0] = max(0, clock[0] + random.choice([1, 1, 1, 0, -3]))
        event = history[-1].event + 1 if history else 1
        number, before = event, history[-1].event if history else 0
        back = [record for record in history if record.event == history[-1].before]
        if back and random.random() < 0.3:
            number, before = back[0].calibration.number, back[0].before
        record = activation(event, before, number)
        timed = dataclasses.replace(record.calibration, active_since_ns=clock[0])
        named = dataclasses.replace(timed, weakest_direction=f'{random.random()}')
        if number != event:
            named = dataclasses.replace(back[0].calibration, active_since_ns=clock[0])
        history = (*history, dataclasses.replace(record, calibration=named))
    return history


def test_any_histories_are_joined() -> None:
    """Each event is there once, in order; a number names one calibration, an event one file."""
    for seed in range(300):
        random, clock = Random(seed), [0]
        common = grown((), random, clock)
        folder, memory = grown(common, random, clock), grown(common, random, clock)
        for _ in range(3):
            last_event = max((record.event for record in folder), default=0)
            both = joined(Kept(history=folder), Kept(history=memory), last_event).history
            events = [record.event for record in both]
            assert events == sorted(set(events))
            assert all(record.before < record.event for record in both)
            origins = [record.origin for record in both]
            assert sorted(origins) == sorted({record.origin for record in (*folder, *memory)})
            names = {(r.calibration.number, r.calibration.weakest_direction) for r in both}
            assert len(names) == len(dict(names))
            of_event = {record.event: record for record in both}
            for record in folder:
                found = of_event.get(record.event)
                assert found is None or found == record or found.origin != record.origin
            start = random.choice([(), memory, folder])
            folder, memory = grown(start, random, clock), both
