# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""State files that cannot be read, beside damaged ones: what is not known is not harmed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile

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


def main(place: Path) -> None:
    """In a process of its own: make each case, and start as a user who owns none of its files."""
    import kept_state  # type: ignore[import-not-found]

    answers = {}
    for k, (change, name, _) in enumerate(CASES.values()):
        folder = place / str(k)
        with kept_state.opened(folder) as archive:
            history = (kept_state.activation(1), kept_state.activation(2, before=1))
            archive.keep(Ensemble(kept_state.images()[:2], {'no_stars': 1}), history)
        if not k:
            start(folder)  # loads all that a start needs while this user may
        change(folder / name)
        for path in (place, folder, *folder.iterdir()):
            if path.stat().st_mode & 0o777:
                path.chmod(0o777)  # anybody may rename the files
    with contextlib.suppress(PermissionError):  # of a user whom modes stop already
        os.setuid(NOBODY)
    for k, case in enumerate(CASES):
        answers[case] = start(place / str(k))
    print(json.dumps(answers))


@pytest.fixture(scope='module')
def started() -> Iterator[tuple[Path, dict[str, tuple[str, list[str]]]]]:
    with tempfile.TemporaryDirectory() as folder:  # others have no access to that of pytest
        done = subprocess.run(
            [sys.executable, __file__, folder], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        yield Path(folder), json.loads(done.stdout)
        for path in Path(folder).glob('*/*'):
            path.chmod(0o700)


@pytest.mark.slow
@pytest.mark.parametrize('case', CASES)
def test_only_what_was_read_and_is_wrong_is_set_aside(
    started: tuple[Path, dict[str, tuple[str, list[str]]]], case: str
) -> None:
    """The start ends where a file may be sound; nothing is renamed then."""
    place, answers = started
    _, name, outcome = CASES[case]
    folder = place / str(list(CASES).index(case))
    (folder / name).parent.chmod(0o700)
    error, damage = answers[case]
    aside = [path for path in names(folder) if '.damaged' in path]
    if outcome == STOPS:
        assert f'{folder / name} cannot be read: Permission denied; start the' in error
        assert aside == [] and error.count('\n') == 0
    else:
        assert error == '' and len(damage) == 1 and outcome in damage[0]
        assert aside == ([f'{name}.damaged'] if outcome == SET_ASIDE else [])


if __name__ == '__main__':
    test = Path(__file__).parents[1]
    sys.path[:0] = [str(test.parent), str(test)]
    main(Path(sys.argv[1]))
