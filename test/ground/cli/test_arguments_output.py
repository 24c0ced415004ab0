# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Outputs that name inputs or files of others (`WRITING`); streams that are closed or full."""

import argparse
from collections.abc import Callable
import hashlib
from pathlib import Path
import random
import shutil
import signal
import subprocess
import sys

from attacks import BAG, digests, many, NO_FILES  # type: ignore[import-not-found]
import pytest
from starcal_tool import run  # type: ignore[import-not-found]

from starcal_ground.cli import main
from starcal_ground.mission.export.export_formats import FORMATS
from starcal_ground.written_files import write_marked

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('forked_readers')]


def _prior_in_out(here: Path) -> None:
    text = (here / 'bag/params.yaml').read_text()
    (here / 'bag/params.yaml').write_text(
        text.replace('camera.yaml', str(here / 'out/camera_info.yaml'))
    )


def _link(path: Path, target: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)


def _picture(folder: Path) -> Path:
    """A folder with a picture of the user, whose name a thumbnail could have."""
    folder.mkdir(parents=True)
    (folder / 'image_0001.jpg').write_text('mine')
    return folder


_OWN = '--params HERE/bag/params.yaml -o'
_IMPORT = 'import --images HERE/frames/0.png --times HERE/frames/times.csv --attitude'
PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
    'folder of the bag': (Path.exists, f'calibrate HERE/bag {_OWN} HERE/bag'),
    'folder of the file': (Path.exists, f'calibrate HERE/bag/tiny_0.mcap {_OWN} HERE/bag'),
    'observations of the folder': (
        Path.exists, f'calibrate HERE/out/observations.mcap {_OWN} HERE/out',
    ),
    'link to the bag': (
        lambda here: _link(here / 'out/observations.mcap', here / 'bag/tiny_0.mcap'),
        f'calibrate HERE/bag {_OWN} HERE/out',
    ),
    'prior in the folder': (_prior_in_out, f'calibrate HERE/bag {_OWN} HERE/out'),
    'pictures of others': (
        lambda here: _picture(here / 'new/thumbnails'), f'calibrate HERE/bag {_OWN} HERE/new',
    ),
    'pictures by a link': (
        lambda here: _link(here / 'out/thumbnails', _picture(here / 'pictures')),
        f'calibrate HERE/bag {_OWN} HERE/out',
    ),
    'table over residuals': (
        lambda here: (here / 'out/residuals.npz').write_text('residuals'),
        'lookup HERE/out -o HERE/out/residuals.npz',
    ),
    'simulation over a recorded bag': (
        lambda here: (here / 'bag/truth.json').unlink(),
        'simulate --scenario tiny -o HERE/bag',
    ),
    'pointings over the bag': (
        lambda here: shutil.rmtree(here / 'out'),
        f'plan HERE/bag {_OWN} HERE/bag/tiny_0.mcap',
    ),
    'pointings over the allowed ones': (
        lambda here: write_marked(here / 'allowed.csv', 'ra_deg,dec_deg\n1,2\n'),
        f'plan HERE/bag --pointings HERE/allowed.csv {_OWN} HERE/allowed.csv',
    ),
    'catalog over its table': (
        lambda here: write_marked(here / 'gaia.npz', 'a table'),
        'catalog HERE/gaia.npz -o HERE/gaia.npz',
    ),
    'simulation in a folder with another bag': (
        lambda here: (here / 'bag').rename(here / 'night'),
        'simulate --scenario tiny -o HERE/night',
    ),
    'import over its attitudes': (
        lambda here: (here / 'frames/attitude.csv').rename(here / 'frames/import.json'),
        f'{_IMPORT} HERE/frames/import.json -o HERE/frames',
    ),
    'straight image over its original': (
        Path.exists, 'undistort HERE/out HERE/frames/0.png -o HERE/frames',
    ),
    'straight images of one name': (
        lambda here: shutil.copytree(here / 'frames', here / 'others'),
        'undistort HERE/out HERE/frames/0.png HERE/others/0.png -o HERE/straight',
    ),
    'simulation beside a damaged truth': (
        lambda here: (here / 'bag/truth.json').write_text('[' * 10**6),
        'simulate --scenario tiny -o HERE/bag',
    ),
}  # fmt: skip


@pytest.mark.parametrize('name', PLACES)
def test_an_output_that_names_an_input_is_refused(name, campaign, tmp_path, capsys) -> None:
    prepare, command = PLACES[name]
    here = tmp_path / 'campaign'
    shutil.copytree(campaign, here)
    prepare(here)
    before = digests(here)
    assert main.main([word.replace('HERE', str(here)) for word in command.split()]) == 2
    assert ''.join(capsys.readouterr()).count('\n') == 1
    assert digests(here) == before


_OF_BAG = 'HERE/bag --params HERE/bag/params.yaml'
_CK = '--kernels HERE/naif.tls HERE/clock.tsc'
WRITING: dict[str, str] = {
    f'calibrate {_OF_BAG} -o HERE/o': (
        'calibration.json camera_info.yaml observations.mcap residuals.npz report.html'
        ' thumbnails/image_1.jpg not_calibrated.json'
    ),
    'report HERE/o': 'report.html',
    'calibrate HERE/bag -o HERE/o': 'params.yaml camera.yaml',
    f'plan {_OF_BAG} --images 1 --pointings HERE/places.csv -o HERE/o/plan.csv': 'plan.csv',
    'lookup HERE/out -o HERE/o/a.csv --points 2': 'a.csv',
    'lookup HERE/out -o HERE/o/a.npz --points 2': 'a.npz',
    'simulate --scenario tiny -o HERE/o': (
        'o_0.mcap metadata.yaml truth.json params.yaml camera.yaml'
    ),
    'simulate --scenario tiny -o HERE/o/b.mcap': ('b.mcap b.json b_params.yaml b_camera.yaml'),
    f'{_IMPORT} HERE/frames/attitude.csv --camera HERE/bag/camera.yaml -o HERE/o': (
        'o_0.mcap metadata.yaml import.json params.yaml camera.yaml'
    ),
    f'{_IMPORT} HERE/frames/attitude.csv --camera HERE/bag/camera.yaml -o HERE/o/b.mcap': (
        'b.mcap b_import.json b_params.yaml b_camera.yaml'
    ),
    'catalog HERE/gaia.csv -o HERE/o/deep.npz': 'deep.npz',
    'trend HERE/out -o HERE/o': 'trend.html',
    'undistort HERE/out HERE/frames/0.png -o HERE/o': '0.png camera_info.yaml',
    'export HERE/out --to c -o HERE/o': 'starcal_camera.c starcal_camera.h',
    'export HERE/out --to c --table -o HERE/o': 'starcal_camera.bin',
    'export HERE/out --to giant -o HERE/o': 'giant_camera.json',
    'export HERE/out --to isd --spacecraft-id -9 -o HERE/o': 'camera_isd.json camera_isis.ti',
    'export HERE/out --to mrcal -o HERE/o': 'camera.cameramodel',
    'export HERE/out --to opencv -o HERE/o': 'opencv.yaml',
    'export HERE/out --to ros -o HERE/o': 'camera_info.yaml alignment.yaml',
    'export HERE/out --to spice --spacecraft-id -9 -o HERE/o': 'camera.tf camera.ti',
    'export HERE/out --to wcs -o HERE/o': 'image0001.wcs image0010.wcs',
    f'export HERE/out --to ck --spacecraft-id -999 -o HERE/o {_CK}': 'camera.bc',
}
"""Commands that write, and the files that they write in ``o/``."""
WITH_NODES = {'demo -o HERE/o': 'demo_params.yaml calibrator.log report.html calibration.json'}


def _foreign(path: Path) -> None:
    path.write_bytes(b'of another program')


def _edited(path: Path) -> None:
    write_marked(path, 'of an earlier run\n')
    with path.open('a') as file:
        file.write('and of the user\n')


OF_OTHERS: dict[str, Callable[[Path], object]] = {
    'foreign': _foreign,
    'edited': _edited,
    **{kind: NO_FILES[kind] for kind in ('folder', 'dangling link', 'pipe')},
}


def test_each_command_that_writes_is_in_the_table() -> None:
    """One without an option -o that writes is `report`."""
    actions = main.parser()._actions
    commands = next(one for one in actions if isinstance(one, argparse._SubParsersAction))
    writing = {
        name
        for name, command in commands.choices.items()
        if '--output' in command._option_string_actions
    }
    table = (*WRITING, *WITH_NODES)
    assert {words.partition(' ')[0] for words in table} == {*writing, 'report'}
    assert {words.split()[3] for words in table if words.startswith('export')} == {
        row.name for row in FORMATS
    }


@pytest.mark.parametrize('command', [*WRITING, *WITH_NODES])
def test_what_starcal_did_not_write_is_not_replaced(command, campaign, tmp_path, capsys) -> None:
    """A file of others, or its own that was changed: nothing is written. Its own is replaced."""
    if command.startswith('demo'):
        pytest.importorskip('rclpy')
    here = tmp_path / 'campaign'
    shutil.copytree(campaign, here)
    names = (WRITING | WITH_NODES)[command].split()
    line = [word.replace('HERE', str(here)) for word in command.split()]
    if command.startswith('report'):
        shutil.copytree(campaign / 'out', here / 'o')
    # Every file is looked at; what may stand in its place is one function's for all of them.
    kinds = ((names[0], make) for make in OF_OTHERS.values())
    for name, make in (*kinds, *((name, _foreign) for name in names[1:])):
        file = here / 'o' / name
        file.parent.mkdir(parents=True, exist_ok=True)
        make(file)
        before = digests(here)
        assert main.main(line) == 2, name
        error = ''.join(capsys.readouterr())
        assert error.count('\n') == 1 and f'/o/{name}: ' in error
        assert digests(here) == before
        file.rmdir() if file.is_dir() else file.unlink()
    if command in WITH_NODES:
        return
    for name in names:
        write_marked(here / 'o' / name, 'of an earlier run')
    assert main.main(line) == 0, capsys.readouterr()
    old = hashlib.sha256(b'of an earlier run').hexdigest()
    assert old not in digests(here).values()


@pytest.mark.parametrize(
    'line',
    [
        # One function opens and flushes the streams of all commands.
        *(f'--version {ends}' for ends in ('>&-', '<&- >&- 2>&-', '>/dev/full', '| true')),
        *(f'calibrat {ends}' for ends in ('2>&-', '<&- >&- 2>&-', '2>/dev/full', '2>&1 | true')),
    ],
)
def test_standard_streams_that_are_closed_full_or_abandoned(line) -> None:
    done = run('bash', '-c', f'{sys.executable} -m starcal_ground.cli.main {line}')
    assert 'Traceback' not in done.stdout + done.stderr
    assert 'Exception' not in done.stdout + done.stderr


def test_ctrl_c_in_the_first_two_seconds() -> None:
    """No traceback of starcal: while Python itself starts, its own cannot be prevented."""
    draw = random.Random(15)
    code = 'import sys; from starcal_ground.cli.entry_point import main; print(flush=True)'
    command = [sys.executable, '-c', f'{code}; sys.exit(main())', 'diagnose', str(BAG)]
    for _ in range(many(6)):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()  # Python has started, however busy the machine is
        try:
            process.communicate(timeout=draw.uniform(0.05, 1.8))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        errors = process.communicate()[1].decode(errors='replace')
        assert 'Traceback' not in errors or '/starcal_' not in errors
