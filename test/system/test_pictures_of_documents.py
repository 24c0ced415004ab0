# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands that draw the pictures of the documents, run in the small."""

import functools
from pathlib import Path
import re
import shutil
import sys

import cv2
from mission_files import frames_of, write_pngs  # type: ignore[import-not-found]
import numpy as np
import pytest

from docs import make_gallery, make_images, make_nodes, make_phase, make_real_sky, make_trend
from starcal_ground.simulation import scenario

pytestmark = [pytest.mark.packaging, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
IN_BROWSER = {'report', 'trend'}
IMAGES = ROOT / 'docs' / 'images'
SHOWN = {path.stem for path in IMAGES.iterdir()}
BY_COMMAND = {
    'make_images': {'star_field', 'focal_plane', 'report'},
    'make_gallery': {name for name in SHOWN if name.startswith('gallery_')},
    'make_nodes': {'nodes'},
    'make_real_sky': {'real_sky'},
    'make_phase': {'pixel_phase'},
    'make_trend': {'trend'},
    # `python -m studies paper`: test/studies/test_paper.py draws them from a few images.
    'paper': {f'paper_figure_{k}' for k in (5, 6, 7)},
}


def test_every_picture_has_its_command_and_the_graph_the_topics_of_the_nodes() -> None:
    assert set().union(*BY_COMMAND.values()) == SHOWN
    assert (IMAGES / 'nodes.svg').read_text() == make_nodes.nodes().document()
    interface = (ROOT / 'docs' / 'nodes.md').read_text()
    labels = [*(label for *_, labels in make_nodes.TOPICS for label in labels),
              *make_nodes.SERVICES]  # fmt: skip
    for name in ' '.join(labels).replace(',', '').split():
        assert re.search(rf'^\| (pub|sub|srv) \| `{name}` \|', interface, re.MULTILINE), name


def small_images(patch: pytest.MonkeyPatch, _: Path) -> None:
    tiny = scenario.scenario('tiny')
    patch.setattr(scenario, 'scenario', lambda _: tiny)
    patch.setattr(make_images, 'SHOWN_IMAGE', 3)
    patch.setattr(make_images, 'CLOSE_UP_FIRST', (300, 200))


def small_phase(patch: pytest.MonkeyPatch, _: Path) -> None:
    patch.setattr(make_phase, 'IMAGES', 1)
    patch.setattr(make_phase, 'FLUXES_ELECTRONS', (2e3, 2e4))


def small_real_sky(_: pytest.MonkeyPatch, folder: Path) -> None:
    write_pngs(folder / 'photographs', frames_of(10))


def small_trend(patch: pytest.MonkeyPatch, folder: Path) -> None:
    write = functools.partial(make_trend.write_mission, months=3)
    patch.setattr(make_trend, 'write_mission', write)
    patch.setattr(make_trend, 'FOLDER', folder)
    patch.chdir(folder)  # the command changes its folder: come back from there


@pytest.mark.parametrize(
    ('command', 'line', 'in_small'),
    [
        (make_images, '{folder}', small_images),
        (make_gallery, '{folder}', None),
        (make_phase, '{folder}/pixel_phase.svg', small_phase),
        (make_real_sky, '{folder}/photographs {folder}', small_real_sky),
        (make_trend, '{folder}', small_trend),
    ],
)
def test_a_command_draws_its_pictures(command, line, in_small, monkeypatch, tmp_path) -> None:
    if in_small is not None:
        in_small(monkeypatch, tmp_path)
    name = command.__name__.rpartition('.')[2]
    monkeypatch.setattr(sys, 'argv', [name, *line.format(folder=tmp_path).split()])
    assert not command.main()
    drawn = {path.stem for path in tmp_path.iterdir() if path.suffix in ('.png', '.svg')}
    expected = BY_COMMAND[name]
    if not (shutil.which('chromium') or shutil.which('google-chrome')):
        expected = expected - IN_BROWSER
    assert drawn == expected
    for path in tmp_path.glob('gallery_*.png'):  # drawn in whole, unlike the others
        drawn_px, shown_px = (cv2.imread(str(one)) for one in (path, IMAGES / path.name))
        assert drawn_px is not None and shown_px is not None, path.name
        assert drawn_px.shape == shown_px.shape, path.name
        assert np.mean(cv2.absdiff(drawn_px, shown_px) > 60) < 0.01, path.name
