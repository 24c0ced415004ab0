# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each Python file names its copyright holder and its licence."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[2]
FOLDERS = (
    'bench',
    'docs',
    'examples',
    'launch',
    'starcal_ground',
    'starcal_ros',
    'studies',
    'test',
    'tools',
)
LINE = '# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0'


def test_each_file_has_the_line() -> None:
    """One line, as the holder and the licence of package.xml."""
    package = ElementTree.parse(ROOT / 'package.xml')
    assert f'Copyright 2026 {package.findtext("maintainer")}.' in LINE
    assert LINE.endswith(f': {package.findtext("license")}')
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob('*.py')]
    assert len(files) > 200
    lacking = [
        path.relative_to(ROOT)
        for path in files
        if '_build' not in path.parts and path.read_text().partition('\n')[0] != LINE
    ]
    assert not lacking, f'put {LINE!r} on the first line of {lacking}'
