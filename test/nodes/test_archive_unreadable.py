# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""State files that cannot be read, beside damaged ones: what is not known is not harmed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import os
from pathlib import Path
import tempfile

from kept_state import activation, images, opened  # type: ignore[import-not-found]
import pytest

from starcal_ros.errors import ArchiveError
from starcal_ros.records import Ensemble
from starcal_ros.ros.archive import Archive

NOBODY = 65534
IMAGE, REFUSED = 'ensemble/00000001.mcap', 'ensemble/refused.json'
EVENT = 'calibrations/00000002_calibration_00000002.json'


def no_access(path: Path) -> None:
    path.chmod(0)


def directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


def dangling_link(path: Path) -> None:
    path.unlink()
    path.symlink_to('nowhere')


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


STOPS, SKIPPED, SET_ASIDE = 'cannot be read', 'not a regular file, skipped', 'set aside'
CASES: dict[str, tuple[Callable[[Path], None], str, str]] = {
    **{f'no_access {name}': (no_access, name, STOPS) for name in (IMAGE, REFUSED, EVENT)},
    **{f'no_access {name}': (no_access, name, STOPS) for name in ('ensemble', 'calibrations')},
    **{f'directory {name}': (directory, name, SKIPPED) for name in (IMAGE, REFUSED, EVENT)},
    **{f'dangling_link {name}': (dangling_link, name, SKIPPED) for name in (IMAGE, EVENT)},
    **{f'fifo {name}': (fifo, name, SKIPPED) for name in (IMAGE, EVENT)},
    **{f'cut {name}': (cut, name, SET_ASIDE) for name in (IMAGE, REFUSED, EVENT)},
}


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.glob('*/*'))


def start(folder: Path) -> tuple[str, list[str]]:
    """Error and damage of a start with a state folder."""
    try:
        with contextlib.closing(Archive(folder, 'camera')) as archive:
            archive.read_ensemble(), archive.read_history()
            return '', archive.damage
    except ArchiveError as error:
        return str(error), []


@contextlib.contextmanager
def as_nobody() -> Iterator[None]:
    """The process as a user who owns none of the files; as it is where it may not change that."""
    with contextlib.ExitStack() as stack:
        if os.geteuid() == 0:  # modes stop any other user already
            os.seteuid(NOBODY)
            stack.callback(os.seteuid, 0)
        yield


@pytest.mark.slow
@pytest.mark.parametrize('case', CASES)
def test_only_what_was_read_and_is_wrong_is_set_aside(case: str) -> None:
    """The start ends where a file may be sound; nothing is renamed then."""
    change, name, outcome = CASES[case]
    with tempfile.TemporaryDirectory() as place:  # others have no access to that of pytest
        folder = Path(place) / 'state'
        with opened(folder) as archive:
            history = (activation(1), activation(2, before=1))
            archive.keep(Ensemble(images()[:2], {'no_stars': 1}), history)
        start(folder)  # loads all that a start needs while this user may
        change(folder / name)
        for path in (Path(place), folder, *folder.iterdir()):
            if path.stat().st_mode & 0o777:
                path.chmod(0o777)  # anybody may rename the files
        with as_nobody():
            error, damage = start(folder)
        for path in folder.iterdir():
            path.chmod(0o700)
        aside = [path for path in names(folder) if '.damaged' in path]
    if outcome == STOPS:
        assert f'{folder / name} cannot be read: Permission denied; start the' in error
        assert aside == [] and error.count('\n') == 0
    else:
        assert error == '' and len(damage) == 1 and outcome in damage[0]
        assert aside == ([f'{name}.damaged'] if outcome == SET_ASIDE else [])
