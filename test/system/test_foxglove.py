# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The Foxglove layout: every panel is placed and shows published fields."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import re
from typing import Any

import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

ROOT = Path(__file__).resolve().parents[2]
LAYOUT = json.loads((ROOT / 'config' / 'foxglove.json').read_text())
PANELS = LAYOUT['configById']
PATH = re.compile(r'(/[\w/]+)((?:\.\w+(?:\[[:\d]*\])?)*)')
# What Foxglove offers at the version that this was written for; another name is an empty panel.
KINDS = {
    'Image', 'Indicator', 'DiagnosticSummary', 'StateTransitions', 'Plot', 'RawMessages', 'Tab',
}  # fmt: skip


def published() -> dict[str, str]:
    """Types of topics by name, from the table of the interface document."""
    text = (ROOT / 'docs' / 'icd.md').read_text()
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
    }  # fmt: skip


@pytest.mark.parametrize('path', sorted(set(paths(PANELS))))
def test_each_path_is_a_field_of_a_published_topic(path: str) -> None:
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
