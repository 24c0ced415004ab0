# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Outputs that name inputs or files of others, and standard streams that are closed or full."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import random
import shutil
import signal
import subprocess
import sys

from attacks import BAG, digests, in_time, many, write_product_folder  # type: ignore[import-not-found]
import pytest

from starcal_ros.cli import main

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag with its files, and the products of an earlier calibration of it in ``out/``."""
    folder = tmp_path_factory.mktemp('campaign')
    shutil.copytree(BAG, folder / 'bag')
    write_product_folder(folder / 'out')
    (folder / 'out/report.html').write_text('a page')
    return folder


def _prior_in_out(here: Path) -> None:
    text = (here / 'bag/params.yaml').read_text()
    (here / 'bag/params.yaml').write_text(
        text.replace('camera.yaml', str(here / 'out/camera_info.yaml'))
    )


def _nothing(here: Path) -> None:
    pass


def _link(path: Path, target: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)


def _picture(folder: Path) -> Path:
    """A folder with a picture of the user, whose name a thumbnail could have."""
    folder.mkdir(parents=True)
    (folder / 'image_0001.jpg').write_text('mine')
    return folder


_OWN = '--params HERE/bag/params.yaml -o'
PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
    'folder of the bag': (_nothing, f'calibrate HERE/bag {_OWN} HERE/bag'),
    'folder of the bag, by another name': (
        _nothing, f'calibrate HERE/bag {_OWN} HERE/out/../bag/.',
    ),
    'folder of the bag, by a link': (
        lambda here: (here / 'link').symlink_to(here / 'bag'),
        f'calibrate HERE/bag {_OWN} HERE/link',
    ),
    'folder of the file': (_nothing, f'calibrate HERE/bag/tiny_0.mcap {_OWN} HERE/bag'),
    'observations of the folder': (
        _nothing, f'calibrate HERE/out/observations.mcap {_OWN} HERE/out',
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
    'figure over a product': (
        lambda here: (here / 'figure.svg').hardlink_to(here / 'out/calibration.json'),
        'compare HERE/out HERE/out -o HERE/figure.svg',
    ),
    'table over residuals': (
        lambda here: (here / 'out/residuals.npz').write_text('residuals'),
        'lookup HERE/out -o HERE/out/residuals.npz',
    ),
    'simulation over a recorded bag': (
        lambda here: (here / 'bag/truth.json').unlink(),
        'simulate --scenario tiny -o HERE/bag',
    ),
    'simulation over a file': (
        lambda here: (here / 'a.mcap').write_text('recorded'),
        'simulate --scenario tiny -o HERE/a.mcap',
    ),
    'simulation over parameters': (
        lambda here: (here / 'a_params.yaml').write_text('mine'),
        'simulate --scenario tiny -o HERE/a.mcap',
    ),
    'simulation in a folder with another bag': (
        lambda here: (here / 'bag').rename(here / 'night'),
        'simulate --scenario tiny -o HERE/night',
    ),
    'simulation beside a damaged truth': (
        lambda here: (here / 'bag/truth.json').write_text('[' * 10**6),
        'simulate --scenario tiny -o HERE/bag',
    ),
}  # fmt: skip


@pytest.mark.parametrize('name', PLACES)
def test_an_output_that_names_an_input_is_refused(
    name: str, campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """-o names an input, its folder, or a file of another origin: nothing is changed."""
    prepare, command = PLACES[name]
    here = tmp_path / 'campaign'
    shutil.copytree(campaign, here)
    prepare(here)
    before = digests(here)
    with in_time():
        assert main.main([word.replace('HERE', str(here)) for word in command.split()]) == 2
    assert ''.join(capsys.readouterr()).count('\n') == 1
    assert digests(here) == before


@pytest.mark.parametrize(
    'ends', ['>&-', '2>&-', '>&- 2>&-', '<&- >&- 2>&-', '>/dev/full', '| true', '2>&1 | true']
)
@pytest.mark.parametrize('bag', [BAG, '/none'])
def test_standard_streams_that_are_closed_full_or_abandoned(bag: object, ends: str) -> None:
    command = f'{sys.executable} -m starcal_ros.cli.main inspect {bag} {ends}'
    done = subprocess.run(['bash', '-c', command], capture_output=True, text=True, timeout=60)
    assert 'Traceback' not in done.stdout + done.stderr
    assert 'Exception' not in done.stdout + done.stderr


def test_ctrl_c_in_the_first_two_seconds() -> None:
    """No traceback of starcal: while Python itself starts, its own cannot be prevented."""
    draw = random.Random(15)
    code = 'import sys; from starcal_ros.cli.entry_point import main; sys.exit(main())'
    command = [sys.executable, '-c', code, 'inspect', str(BAG)]
    for _ in range(many(6)):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            process.communicate(timeout=draw.uniform(0.2, 2.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        errors = process.communicate(timeout=60)[1].decode(errors='replace')
        assert 'Traceback' not in errors or 'starcal_ros' not in errors
