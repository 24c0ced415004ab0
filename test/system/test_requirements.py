# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The pinned requirements: pip installs only files whose digests are in the repository."""

from __future__ import annotations

from pathlib import Path
import re

import pytest
from tool_modules import tool  # type: ignore[import-not-found]

ROOT = Path(__file__).parents[2]


def test_every_pin_has_its_digests() -> None:
    """And there are none of other versions: `tools.write_hashes` was run after the last change."""
    lines = (ROOT / 'requirements/hashes.txt').read_text().splitlines()
    hashed = [line.split() for line in lines if not line.startswith('#')]
    assert {tuple(pin.split('==')) for pin, _, _ in hashed} == tool('write_hashes').pins()
    for _, digest, file in hashed:
        assert re.fullmatch('sha256:[0-9a-f]{64}', digest), file


def test_pip_is_given_the_digests(tmp_path: Path) -> None:
    make_venv, path = tool('make_venv'), tmp_path / 'some.txt'
    path.write_text('# why\nempy==3.3.4 ; python_version > "3.9"  # old\n')
    (line,) = make_venv.hashed_lines(path)
    assert line.startswith('empy==3.3.4 ; python_version > "3.9" --hash=sha256:73ac49785b6')
    path.write_text('empy==3.3.3\n')
    with pytest.raises(SystemExit, match='tools.write_hashes'):
        make_venv.hashed_lines(path)
