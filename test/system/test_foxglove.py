# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The Foxglove layout: every panel is placed and shows published fields."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import re
import shutil
import subprocess
from typing import Any

import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = json.loads((ROOT / 'config' / 'foxglove.json').read_text())
PANELS = LAYOUT['configById']
SCRIPTS = {name: node['sourceCode'] for name, node in LAYOUT['userNodes'].items()}
PATH = re.compile(r'(/[\w/]+)((?:\.\w+(?:\[[:\d]*\])?)*)')
# What Foxglove offers at the version that this was written for; another name is an empty panel.
KINDS = {
    'Image', 'Indicator', 'DiagnosticSummary', 'StateTransitions', 'Plot', 'RawMessages', 'Tab',
    'CallService',
}  # fmt: skip


def published() -> dict[str, str]:
    """Types of topics by name, from the table of the interface document."""
    text = (ROOT / 'docs' / 'nodes.md').read_text()
    rows = re.findall(r'^\| pub \| `([^`]+)` \| \[?(\w+)/(\w+)', text, re.MULTILINE)
    return {'/' + name.lstrip('/'): f'{package}/msg/{kind}' for name, package, kind in rows}


def paths(content: object, key: str = '') -> Iterator[str]:
    """Message paths of a panel."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield from paths(value, name)
    elif isinstance(content, list):
        for value in content:
            yield from paths(value, key)
    elif key in ('value', 'path', 'topicPath', 'imageTopic', 'topicToRender') and content:
        yield str(content)


def placed(layout: object) -> Iterator[str]:
    """The panels at the leaves of a layout."""
    if isinstance(layout, str):
        yield layout
    else:
        assert isinstance(layout, dict)
        assert layout['direction'] in ('row', 'column')
        assert 5 <= layout['splitPercentage'] <= 95
        for side in ('first', 'second'):
            yield from placed(layout[side])


def test_it_is_a_layout() -> None:
    assert set(LAYOUT) == {
        'configById', 'globalVariables', 'userNodes', 'playbackConfig', 'layout',
    }  # fmt: skip
    assert {name.partition('!')[0] for name in PANELS} == KINDS


def test_every_panel_is_placed_once() -> None:
    leaves = list(placed(LAYOUT['layout']))
    for panel in PANELS.values():
        for tab in panel.get('tabs', ()):
            leaves += placed(tab['layout'])
    assert sorted(leaves) == sorted(PANELS)


def test_what_matters_is_shown() -> None:
    topics = {PATH.match(path)[1] for path in paths(PANELS)}  # type: ignore[index]
    assert topics == {
        '/annotated_image', '/calibration', '/diagnostics', '/ensemble_status', '/observations',
        *(f'/studio_script/{name}' for name in SCRIPTS),
    }  # fmt: skip
    button = PANELS['CallService!calibrate']
    assert (button['serviceName'], button['requestPayload']) == ('/calibrator/calibrate', '{}')


def test_scripts_read_published_topics_and_are_named_after_their_output() -> None:
    for name, source in SCRIPTS.items():
        assert f'export const output = "/studio_script/{name}";' in source
        inputs = re.findall(r'export const inputs = \[(.*?)\];', source)[0]
        assert set(re.findall(r'"([^"]+)"', inputs)) <= set(published())


NODE = shutil.which('node') or ''
# Runs a script as Foxglove does: once for each message, 64-bit integers as BigInt.
_RUN = """
import script from './script.mjs';
const message = JSON.parse(process.argv[2], (key, value) =>
  key === 'coverage' ? value.map(BigInt) : value === null ? NaN : value);
for (const event of message) var made = script(event);
console.log(JSON.stringify(made, (key, value) => ArrayBuffer.isView(value) ? [...value] : value));
"""


def without_types(source: str) -> str:
    """Return a script as JavaScript; Node 22 could do this by itself."""
    source = re.sub(r'import \{[^}]*\} from "./types";|^type .*;$', '', source, flags=re.MULTILINE)
    source = re.sub(r'new Map<[^>]*>', 'new Map', source)
    return re.sub(r'script\(\s*event: [^)]*\): [^\n]* \{$', 'script(event) {', source, flags=re.M)


def made_by(name: str, folder: Path, *events: dict[str, Any]) -> Any:
    """Return what a script makes of the last of some events."""
    (folder / 'script.mjs').write_text(without_types(SCRIPTS[name]))
    (folder / 'run.mjs').write_text(_RUN)
    done = subprocess.run(
        [NODE, 'run.mjs', json.dumps(events)],
        cwd=folder, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.skipif(not NODE, reason='no Node on this machine')
def test_scripts_make_a_picture_and_ratios(tmp_path) -> None:
    coverage = {'coverage': [0, 1, 2, 4], 'coverage_rows': 2, 'coverage_cols': 2, 'header': {}}
    collected = {
        'parameter_names': ['fx', 'cx'], 'predicted_sigma': [0.5, 3.0], **coverage
    }  # fmt: skip
    status = {'topic': '/ensemble_status', 'message': collected}
    picture = made_by('coverage', tmp_path, status)
    assert (picture['height'], picture['width'], picture['step']) == (64, 64, 64)
    cells = [picture['data'][k] for k in (0, 32, 64 * 32, 64 * 64 - 1)]
    assert cells == [0, 64 + 48, 64 + 96, 255]
    check = {'option': 'max_x', 'found': 0.5, 'limit': 2.0}
    gate = [check, {'option': 'min_x', 'found': 8.0, 'limit': 2.0}, {**check, 'limit': None}]
    active = {
        'topic': '/calibration',
        'message': {
            'parameter_names': ['fx', 'cy'], 'covariance': [4.0, 0.0, 0.0, 1.0], 'gate': gate
        },
    }  # fmt: skip
    assert made_by('limits', tmp_path, active) == {'of_limit': [0.25, 0.25]}
    # cx was held in the active calibration: JSON writes NaN as null.
    assert made_by('sigmas', tmp_path, active, status) == {'over_active': [0.25, None]}


@pytest.mark.parametrize('path', sorted(p for p in set(paths(PANELS)) if 'studio' not in p))
def test_each_path_is_a_field_of_a_published_topic(path) -> None:
    match = PATH.fullmatch(path)
    assert match is not None
    kind = published()[match[1]]
    store = get_typestore(Stores.ROS2_JAZZY)
    for file in (ROOT / 'msg').glob('*.msg'):
        store.register(get_types_from_msg(file.read_text(), f'starcal/msg/{file.stem}'))
    fields: dict[str, Any] = dict(store.fielddefs[kind][1])
    for part in re.findall(r'\.(\w+)(\[)?', match[2]):
        assert part[0] in fields
        node, description = fields[part[0]]
        is_array = int(node) in (3, 4)  # rosbags: array, sequence
        assert is_array == bool(part[1])
        if is_array:
            node, description = description[0]
        fields = dict(store.fielddefs[description][1]) if int(node) == 2 else {}  # 2: a message
