# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The example for Kubernetes in docs/mission_trend.md, as far as it runs without a cluster."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import re
import socket
import subprocess
import sys
from typing import Any

import pytest
import yaml

pytestmark = pytest.mark.slow

_DOCUMENT = (Path(__file__).parents[4] / 'docs/mission_trend.md').read_text()
_PLACE = Path(sys.executable).parent
_START_S = 240.0


def example(language: str, word: str) -> str:
    fences = re.findall(rf'```{language}\n(.*?)```', _DOCUMENT, re.DOTALL)
    (found,) = (text for text in fences if word in text)
    return str(found)


@contextlib.contextmanager
def container(
    cluster: dict[str, Any], part: str, *more: str, **environment: str
) -> Iterator[None]:
    """The process of a container, with the variables that the operator gives it."""
    (found,) = cluster['spec'][part]['spec']['containers']
    line = [re.sub(r'\$\((\w+)\)', lambda name: environment[name[1]], a) for a in found['args']]
    process = subprocess.Popen(
        [_PLACE / line[0], *line[1:], *more],
        env={**os.environ, **environment},
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def test_the_containers_of_kubernetes_find_each_other() -> None:
    from distributed import Client  # its import takes a second

    cluster = yaml.safe_load(example('yaml', 'DaskCluster'))
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    address, name = f'tcp://127.0.0.1:{port}', 'starcal-default-worker-1'
    with (
        container(cluster, 'scheduler', '--port', str(port), '--dashboard-address', ':0'),
        container(cluster, 'worker', DASK_SCHEDULER_ADDRESS=address, DASK_WORKER_NAME=name),
        Client(address, timeout=_START_S) as client,
    ):
        client.wait_for_workers(1, timeout=_START_S)
        (worker,) = client.scheduler_info()['workers'].values()
        assert (worker['name'], worker['nthreads']) == (name, 1)
