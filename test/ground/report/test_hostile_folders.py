# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Reports of folders with odd calibrations, links, FIFOs and devices."""

from __future__ import annotations

import base64
from collections.abc import Callable
import json
from pathlib import Path
import shutil
from typing import Any

from attacks import CHANGES, drawn, with_changes, write_product_folder  # type: ignore[import-not-found]
from hypothesis import given
import pytest

from starcal_ground.cli import main
from starcal_ground.report.thumbnails import Thumbnail, THUMBNAILS_FOLDER, write_thumbnails
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration

pytestmark = pytest.mark.slow

JPEG = b'\xff\xd8\xff'
SECRET = JPEG + b'a file outside of the folder'


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Products of a calibration; tests change copies."""
    path = tmp_path_factory.mktemp('products') / 'out'
    write_product_folder(path)
    return path


@pytest.fixture(scope='module')
def content(folder: Path) -> Any:
    """The calibration file as a JSON object."""
    return json.loads((folder / CALIBRATION_FILE).read_text())


@drawn(60)
@given(CHANGES)
def test_a_calibration_with_odd_values_is_read_or_refused_in_one_line(
    folder: Path, content: Any, changes: list[tuple[int, object]]
) -> None:
    path = folder / 'odd.json'
    path.write_text(json.dumps(with_changes(content, changes)))
    refusal = ''
    try:
        read_calibration(path)
    except ProductError as error:
        refusal = str(error)
    assert '\n' not in refusal and len(refusal) < 1000


def _in_pictures(here: Path, name: str) -> Path:
    write_thumbnails([Thumbnail(1, b'\xff\xd8\xff')], here / THUMBNAILS_FOLDER)
    return here / THUMBNAILS_FOLDER / name


def _folder_of_secret(here: Path, secret: Path) -> None:
    outside = secret.with_name('outside')
    shutil.rmtree(outside, ignore_errors=True)
    outside.mkdir()
    shutil.copy(secret, outside / 'image_5.jpg')
    (here / THUMBNAILS_FOLDER).symlink_to(outside)


PICTURES: dict[str, Callable[[Path, Path], object]] = {
    'link': lambda here, secret: _in_pictures(here, 'image_5.jpg').symlink_to(secret),
    'link to a folder': _folder_of_secret,
}


@pytest.mark.parametrize('name', PICTURES)
def test_a_report_shows_nothing_from_outside(name: str, folder: Path, tmp_path: Path) -> None:
    secret, here = tmp_path / 'secret', tmp_path / 'linked'
    secret.write_bytes(SECRET)
    shutil.copytree(folder, here)
    PICTURES[name](here, secret)
    assert main.main(['report', str(here)]) in (0, 2)
    page = here / 'report.html'
    encoded = base64.b64encode(SECRET).decode()[:-4]
    assert not page.exists() or encoded not in page.read_text()


@drawn(5)
@given(CHANGES)
def test_a_report_of_an_odd_calibration(
    folder: Path, content: Any, changes: list[tuple[int, object]]
) -> None:
    changed = folder.with_name('changed')
    shutil.copytree(folder, changed, dirs_exist_ok=True)
    (changed / CALIBRATION_FILE).write_text(json.dumps(with_changes(content, changes)))
    assert main.main(['report', str(changed)]) in (0, 2)
