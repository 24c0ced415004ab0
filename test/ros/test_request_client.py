# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""``starcal request`` against a running calibrator."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from conftest import Client, StartNode

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from std_srvs.srv import Trigger

pytestmark = pytest.mark.nodes


def request(*words: str | Path) -> tuple[int, str, str]:
    command = [sys.executable, '-m', 'starcal_ros.cli.main', 'request', *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    return done.returncode, done.stdout, done.stderr


def test_the_answer_of_the_calibrator_is_printed(
    client: Client, start_node: StartNode, tiny_bag: Path, tmp_path: Path
) -> None:
    params: Sequence[str] = ('--params-file', str(tiny_bag / 'params.yaml'))
    start_node('calibrator', ros=(*params, '-r', '__ns:=/cam1'))
    expected = client.call(Trigger, '/cam1/calibrator/rollback').message
    there = ('--remap', '__ns:=/cam1')
    assert request('rollback', *there) == (3, f'{expected}\n', '')
    status, out, err = request('reset', *there)
    assert status == 0 and out.count('\n') == 1 and err == ''
    for words in (('calibrate',), ('solve', '--dry-run')):
        status, out, err = request(*words, *there)
        assert status == 3 and out and err == ''
    table = tmp_path / 'sights.csv'
    status, out, err = request('lookup', '-o', table, *there)
    assert status == 3 and 'no calibration' in out and not table.exists()


def test_without_a_calibrator_one_line_names_the_remedy(client: Client) -> None:
    status, out, err = request('reset', '--timeout', '0.5')
    assert (status, out) == (2, '') and err.count('\n') == 1
    assert '/calibrator/reset' in err and '__ns:=' in err
