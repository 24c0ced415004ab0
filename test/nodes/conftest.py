# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrators without nodes; files with nodes are skipped where rclpy or messages are missing."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from calibrators import Calibrators  # type: ignore[import-not-found]
import pytest

MISSING = [name for name in ('rclpy', 'starcal') if find_spec(name) is None]


@pytest.fixture
def calibrators(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Calibrators]:
    """Calibrators that share a disk; their folders are released at the end."""
    made = Calibrators(tmp_path, monkeypatch)
    with made.is_full:
        yield made
    made.close_all()


class WithoutRos(pytest.Module):
    """A file of tests that cannot be imported here."""

    def collect(self) -> Iterator[pytest.Item]:
        pytest.skip(f'{MISSING[0]} is not installed')


def pytest_pycollect_makemodule(
    module_path: Path, parent: pytest.Collector
) -> pytest.Module | None:
    """Skip a file of this folder with tests marked ``nodes``."""
    is_with_nodes = module_path.parent == Path(__file__).parent and (
        'pytest.mark.nodes' in module_path.read_text()
    )
    if MISSING and is_with_nodes:
        return WithoutRos.from_parent(parent, path=module_path)
    return None
