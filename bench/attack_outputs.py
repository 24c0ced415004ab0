# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attacks on outputs: -o that names inputs, products with odd values, links, closed streams."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
import json
import os
from pathlib import Path
import random
import shutil
import signal
import subprocess
import sys
import tempfile

from bench import attack_sample as sample
from bench.attack_row import AttackRow
from bench.attack_state import fifo_in_place_of
from starcal_ros.errors import ProductError
from starcal_ros.products.calibration_json import CALIBRATION_FILE, read_calibration
from starcal_ros.products.folder import write_observations, write_products
from starcal_ros.report.pictures.thumbnails import Thumbnail, THUMBNAILS_FOLDER, write_thumbnails

_BAD = 2
_SECRET = b'a file outside of the folder'


def rows(quick: bool) -> list[AttackRow]:
    """Rows for the outputs of the tool."""
    with tempfile.TemporaryDirectory() as folder:
        return [
            places(Path(folder)),
            odd_products(Path(folder), 200 if quick else 10_000),
            reports(
                Path(folder), 0 if quick else 60, _QUICK_PICTURES if quick else tuple(_PICTURES)
            ),
            streams(),
            interrupted_imports(6 if quick else 100),
        ]


def write_campaign(folder: Path) -> None:
    """A bag with its files, and the products of an earlier calibration of it in ``out/``."""
    shutil.copytree(sample.BAG, folder / 'bag')
    write_product_folder(folder / 'out')
    (folder / 'out/report.html').write_text('a page')


def write_product_folder(folder: Path) -> None:
    """The products of a calibration, without a report."""
    folder.mkdir()
    write_products(sample.calibration(), folder)
    write_observations(sample.observations(), folder, 'camera')


def places(folder: Path) -> AttackRow:
    """Outputs that name an input or a file of another origin: refused, and nothing changed."""
    tally, lost = sample.Tally('places'), 0
    for name, (prepare, command) in _PLACES.items():
        with tempfile.TemporaryDirectory(dir=folder) as made:
            here = Path(made) / 'campaign'
            here.mkdir()
            write_campaign(here)
            prepare(here)
            before = sample.digests(here)
            with tally.attempt(name):
                words = [word.replace('HERE', str(here)) for word in command.split()]
                status, said = sample.tool(*words)
                assert status == _BAD and said.count('\n') == 1, (status, said[-300:])
            lost += len(sample.changed(before, sample.digests(here)))
    return AttackRow(
        '-o names an input, its folder, or a file of others', tally.tried, tally.survived, lost, 0
    )


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
_PLACES: dict[str, tuple[Callable[[Path], object], str]] = {
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
        lambda here: (here / 'figure.png').hardlink_to(here / 'out/calibration.json'),
        'compare HERE/out HERE/out -o HERE/figure.png',
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


def odd_products(folder: Path, count: int) -> AttackRow:
    """Calibration files with odd values: read as they are, or refused in one line."""
    tally = sample.Tally('odd products')
    write_product_folder(folder / 'odd')
    path = folder / 'odd' / CALIBRATION_FILE
    content = json.loads(path.read_text())

    def attack(changes: list[tuple[int, object]]) -> None:
        path.write_text(json.dumps(sample.with_changes(content, changes)))
        with tally.attempt(changes):
            said = ''
            try:
                read_calibration(path)
            except ProductError as error:
                said = str(error)
            assert '\n' not in said and len(said) < 1000, 'not one line'

    sample.odd_changes(count, 3, attack)
    return AttackRow('calibration.json with odd values', tally.tried, tally.survived, 0, 0)


def reports(folder: Path, count: int, pictures: Sequence[str]) -> AttackRow:
    """Reports of odd products and of folders with links: one line, and nothing from outside."""
    tally, wrong = sample.Tally('reports'), 0
    secret = folder / 'secret'
    secret.write_bytes(b'\xff\xd8\xff' + _SECRET)
    sound = folder / 'sound'
    write_product_folder(sound)
    for name in pictures:
        put, here = _PICTURES[name], folder / 'linked'
        shutil.copytree(sound, here)
        with tally.attempt(name):
            put(here, secret)
            status, said = sample.tool('report', here)
            assert status in (0, _BAD), said
            page = here / 'report.html'
            wrong += page.exists() and _encoded_secret() in page.read_text()
        shutil.rmtree(here)
    content = json.loads((sound / CALIBRATION_FILE).read_text())

    def attack(changes: list[tuple[int, object]]) -> None:
        (sound / CALIBRATION_FILE).write_text(json.dumps(sample.with_changes(content, changes)))
        with tally.attempt(changes):
            status, said = sample.tool('report', sound)
            assert status == 0 or (status == _BAD and said.count('\n') == 1), said[-300:]

    sample.odd_changes(count, 4, attack)
    return AttackRow(
        'reports of odd products; links, FIFOs and devices in thumbnails/',
        tally.tried, tally.survived, 0, wrong,
    )  # fmt: skip


def _encoded_secret() -> str:
    return base64.b64encode(b'\xff\xd8\xff' + _SECRET).decode()[:-4]


def _in_pictures(here: Path, name: str) -> Path:
    write_thumbnails([Thumbnail(1, '', 0, b'\xff\xd8\xff')], here / THUMBNAILS_FOLDER)
    return here / THUMBNAILS_FOLDER / name


def _folder_of_secret(here: Path, secret: Path) -> None:
    outside = secret.with_name('outside')
    shutil.rmtree(outside, ignore_errors=True)
    outside.mkdir()
    shutil.copy(secret, outside / 'image_5.jpg')
    (here / THUMBNAILS_FOLDER).symlink_to(outside)


_PICTURES: dict[str, Callable[[Path, Path], object]] = {
    'link': lambda here, secret: _in_pictures(here, 'image_5.jpg').symlink_to(secret),
    'link to /dev/zero': lambda here, _: _in_pictures(here, 'image_5.jpg').symlink_to('/dev/zero'),
    'FIFO': lambda here, _: os.mkfifo(_in_pictures(here, 'image_5.jpg')),
    'folder': lambda here, _: _in_pictures(here, 'image_5.jpg').mkdir(),
    'link to a folder': _folder_of_secret,
    'FIFO as calibration': lambda here, _: fifo_in_place_of(here / CALIBRATION_FILE),
    'FIFO as observations': lambda here, _: fifo_in_place_of(here / 'observations.mcap'),
}


_QUICK_PICTURES = ('link', 'link to a folder', 'FIFO as calibration')


def streams() -> AttackRow:
    """Standard streams that are closed, full, or without a reader."""
    tally = sample.Tally('streams')
    tool = f'{sys.executable} -m starcal_ros.cli.main inspect {sample.BAG}'
    for ends in ('>&-', '2>&-', '>&- 2>&-', '<&- >&- 2>&-', '>/dev/full', '| true', '2>&1 | true'):
        for bag in ('', '/none'):
            with tally.attempt(bag + ends):
                done = subprocess.run(
                    ['bash', '-c', f'{tool}{bag} {ends}'],
                    capture_output=True,
                    text=True,
                    timeout=60,
                )
                said = done.stdout + done.stderr
                assert 'Traceback' not in said and 'Exception' not in said, said[-300:]
    return AttackRow(
        'closed, full and abandoned stdout and stderr', tally.tried, tally.tried, 0, 0
    )


def interrupted_imports(count: int) -> AttackRow:
    """SIGINT at a random instant of the first two seconds of the console script."""
    tally = sample.Tally('interrupted imports')
    draw = random.Random(15)
    code = 'import sys; from starcal_ros.cli.entry_point import main; sys.exit(main())'
    command = [sys.executable, '-c', code, 'inspect', str(sample.BAG)]
    for k in range(count):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            # Python itself is started by then: before, its own traceback cannot be prevented.
            process.communicate(timeout=draw.uniform(0.2, 2.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
        with tally.attempt(k):
            said = process.communicate(timeout=60)[1].decode(errors='replace')
            assert 'Traceback' not in said or 'starcal_ros' not in said, said[-400:]
    return AttackRow('Ctrl-C in the first two seconds', tally.tried, tally.survived, 0, 0)
