# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The command against an S3 server: bags, results and page by URL, and a store that fails."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import importlib.util
import io
import os
from pathlib import Path
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request

from mission_files import TINY  # type: ignore[import-not-found]
import pyarrow.parquet as pq
import pytest

from starcal_ros.mission.trend import places

_MISSING = [name for name in ('moto', 'flask', 's3fs') if importlib.util.find_spec(name) is None]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        bool(_MISSING), reason=f'needs pip install moto[server] s3fs: no {", ".join(_MISSING)}'
    ),
]

_RUN = 'import sys; from starcal_ros.cli.main import main; sys.exit(main())'
# Loaded before it is needed, so that a restart takes less than the pauses of a run.
_SERVER = 'import sys; from moto.server import main; sys.stdin.read(); main(sys.argv[1:])'
_BAGS = ['s3://archive/fleet/0', 's3://archive/fleet/1']
_START_S = 60.0
# With the content type of a form the server loses the content; without a key it gives none.
_HEADERS = {'Content-Type': 'application/octet-stream', 'Authorization': 'AWS a:b'}


class Proxy:
    """A TCP proxy before the server, which notes requests, delays them and drops connections."""

    def __init__(self, port: int) -> None:
        self.drop = ''  # pattern of the first line of requests whose connection is closed
        self.delay_s = 0.0
        self.requests: list[str] = []
        self._port = port
        self._listener = socket.create_server(('127.0.0.1', 0))
        self.url = f'http://127.0.0.1:{self._listener.getsockname()[1]}'
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        # close() alone does not wake the thread in accept().
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client, socket.create_connection(('127.0.0.1', self._port)) as server:
            back = threading.Thread(target=_copy, args=(server, client), daemon=True)
            back.start()
            with contextlib.suppress(OSError):
                while data := client.recv(65536):
                    line = data.partition(b'\r\n')[0].decode(errors='replace')
                    if line.endswith('HTTP/1.1'):
                        self.requests.append(line)
                        if self.drop and re.search(self.drop, line):
                            break
                    time.sleep(self.delay_s)
                    server.sendall(data)
            with contextlib.suppress(OSError):
                server.shutdown(socket.SHUT_RDWR)
            back.join()


def _copy(server: socket.socket, client: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := server.recv(65536):
            client.sendall(data)
        client.shutdown(socket.SHUT_RDWR)


class Store:
    """A server with two bags in the bucket `archive`."""

    def __init__(self, url: str, proxy: Proxy, folder: Path) -> None:
        self.url, self.proxy, self.folder = url, proxy, folder

    def request(self, method: str, path: str, content: bytes = b'') -> bytes:
        body = None if method == 'GET' else content  # an empty one has a length, 0
        request = urllib.request.Request(f'{self.url}/{path}', body, _HEADERS, method=method)
        with urllib.request.urlopen(request, timeout=_START_S) as answer:
            return bytes(answer.read())

    def names(self, bucket: str = 'archive') -> list[str]:
        listing = self.request('GET', f'{bucket}?list-type=2').decode()
        return re.findall('<Key>(.*?)</Key>', listing)

    def put_bag(self, k: int) -> None:
        content = (TINY / 'tiny_0.mcap').read_bytes()
        changed = content.replace(b'starcal', b'%07d' % k, 1)  # in the header, which nothing reads
        self.request('PUT', f'archive/fleet/{k}/tiny_0.mcap', changed)
        metadata = (TINY / 'metadata.yaml').read_bytes()
        self.request('PUT', f'archive/fleet/{k}/metadata.yaml', metadata)

    def kept(self) -> list[str]:
        """Bags whose calibrations are kept."""
        names = [name for name in self.names() if name.endswith('/calibration.json')]
        assert all(name.startswith('trend/trend.calibrations/spacecraft=-/') for name in names)
        return sorted(f's3://archive/fleet/{name.split("/")[-2][:-17]}' for name in names)

    def bags_in_table(self) -> list[str]:
        found = []
        for name in self.names():
            if name.endswith('.parquet'):
                file = pq.ParquetFile(io.BytesIO(self.request('GET', f'archive/{name}')))
                found += file.read(['path'])['path'].to_pylist()
        return sorted(found)

    def trend(
        self,
        root: str = 's3://archive/fleet',
        output: str = 's3://archive/trend',
        workers: int = 2,
        **environment: str,
    ) -> subprocess.CompletedProcess[str]:
        settings = {
            'AWS_ACCESS_KEY_ID': 'a',
            'AWS_SECRET_ACCESS_KEY': 'b',
            'AWS_DEFAULT_REGION': 'us-east-1',
            'AWS_ENDPOINT_URL': self.proxy.url,
            'AWS_MAX_ATTEMPTS': '1',
            **environment,
        }
        line = ['trend', root, '-o', output, '--params', str(TINY / 'params.yaml')]
        done = subprocess.run(
            [sys.executable, '-c', _RUN, *line, '--workers', str(workers)],
            cwd=self.folder,
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
            timeout=240,
        )
        assert 'Traceback' not in done.stdout + done.stderr
        return done


class Server:
    """A server process, with another one loaded that takes its port when it is killed."""

    def __init__(self) -> None:
        with socket.create_server(('127.0.0.1', 0)) as free:
            self.port = free.getsockname()[1]
        self.url = f'http://127.0.0.1:{self.port}'
        self._processes = [self._loaded()]

    def _loaded(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, '-c', _SERVER, '-H', '127.0.0.1', '-p', str(self.port)]
        none = subprocess.DEVNULL
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=none, stderr=none)

    def start(self) -> None:
        pipe = self._processes[-1].stdin
        assert pipe is not None
        pipe.close()
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s:
            with contextlib.suppress(OSError), socket.create_connection(('127.0.0.1', self.port)):
                break
            time.sleep(0.1)

    def load_another(self) -> None:
        self._processes.append(self._loaded())

    def kill(self) -> None:
        """Kill the oldest process with SIGKILL."""
        process = self._processes.pop(0)
        process.kill()
        process.wait()


@pytest.fixture(scope='module')
def server() -> Iterator[Server]:
    made = Server()
    made.start()
    yield made
    made.kill()


@pytest.fixture
def store(server: Server, tmp_path: Path) -> Iterator[Store]:
    proxy = Proxy(server.port)
    made = Store(server.url, proxy, tmp_path)
    made.request('POST', 'moto-api/reset')
    made.request('PUT', 'archive')
    for k in range(2):
        made.put_bag(k)
    yield made
    proxy.close()


def test_a_second_run_from_another_folder_reads_no_bag(store: Store) -> None:
    store.proxy.delay_s = 0.05
    assert '2 new, 0 known before, 0 failed' in store.trend().stdout
    assert store.bags_in_table() == store.kept() == _BAGS
    assert 'trend/trend.html' in store.names()
    assert not any('_probe' in name or '_new' in name for name in store.names())
    store.proxy.requests.clear()
    store.folder = store.folder / 'elsewhere'
    store.folder.mkdir()
    assert '0 new, 2 known before, 0 failed' in store.trend().stdout
    assert not any('.mcap' in line or 'calibrations' in line for line in store.proxy.requests)
    assert list(store.folder.iterdir()) == []


@pytest.mark.parametrize(
    ('root', 'output', 'endpoint', 'words'),
    [
        ('s3://none/fleet', 's3://archive/trend', '', 's3://none/fleet: no such folder'),
        ('s3://archive/fleet', 's3://none/trend', '', 'bucket does not exist'),
        ('s3://archive/fleet', 's3://archive/trend', '127.0.0.1:9', 'Invalid endpoint'),
        ('s3://archive/fleet', 's3://archive/trend', 'http://127.0.0.1:9', 'Could not connect'),
    ],
)
def test_a_wrong_place_is_one_line(
    store: Store, root: str, output: str, endpoint: str, words: str
) -> None:
    done = store.trend(root, output, AWS_ENDPOINT_URL=endpoint or store.proxy.url)
    assert done.returncode == 2 and words in done.stderr and done.stderr.count('\n') == 1
    assert not any('.mcap' in line for line in store.proxy.requests)
    assert b'<Name>none</Name>' not in store.request('GET', '')


def test_wrong_credentials_are_one_line(store: Store) -> None:
    store.request('POST', 'moto-api/reset-auth', b'0')
    try:
        done = store.trend()
    finally:
        store.request('POST', 'moto-api/reset-auth', b'inf')
    assert done.returncode == 2 and done.stderr.count('\n') == 1
    assert 's3://archive/fleet: cannot be read: PermissionError: Forbidden' in done.stderr


@pytest.mark.parametrize(
    ('drop', 'words'),
    [
        ('GET /archive/fleet/1/.*mcap', 'cannot be read: '),
        ('PUT .*calibrations/.*/1-', 's3://archive/trend/trend.parquet: cannot be written: '),
    ],
)
def test_a_bag_that_cannot_be_reached_or_kept_is_done_by_the_next_run(
    store: Store, drop: str, words: str
) -> None:
    store.proxy.drop = drop
    done = store.trend()
    assert '1 new, 0 known before, 1 failed' in done.stdout and done.stderr == ''
    (line,) = [line for line in done.stdout.splitlines() if line.startswith('failed: ')]
    assert 's3://archive/fleet/1: ' in line and words in line
    store.proxy.drop = ''
    assert '1 new, 1 known before, 0 failed' in store.trend().stdout
    assert store.bags_in_table() == store.kept() == _BAGS


@pytest.mark.parametrize(
    'drop',
    [
        'PUT .*/_new/',
        'PUT .*/camera(=|%3D)',
        'DELETE .*/_new/',
        'PUT .*html',
    ],
)
def test_a_write_that_fails_is_made_good_by_the_next_run(store: Store, drop: str) -> None:
    store.proxy.drop = drop
    done = store.trend()
    assert done.returncode == 2 and done.stderr.count('\n') == 1
    assert 's3://archive/trend/' in done.stderr and 'onnection' in done.stderr
    store.proxy.drop = ''
    assert ' 0 failed' in store.trend().stdout
    assert store.bags_in_table() == _BAGS


def test_a_bucket_is_listed_by_folders_with_a_request_each(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(places, '_TOGETHER', 1)
    settings = {'ACCESS_KEY_ID': 'a', 'SECRET_ACCESS_KEY': 'b', 'ENDPOINT_URL': store.proxy.url}
    for name, value in settings.items():
        monkeypatch.setenv(f'AWS_{name}', value)
    assert [len(found) for found in places.listings('s3://archive')] == [0, 2, 2]
    # The bucket, its one folder, a probe of the first folder below it; then each of these.
    assert len(store.proxy.requests) == 5
    assert all('list-type=2' in line for line in store.proxy.requests)


def test_a_server_that_is_killed_in_the_run_costs_a_pause(store: Store, server: Server) -> None:
    for k in range(2, 6):
        store.put_bag(k)
    server.load_another()
    killed: list[int] = []

    def kill_and_restart() -> None:
        while len(store.kept()) < 2:
            time.sleep(0.05)
        # One worker: it writes nothing until it has calibrated the next bag.
        content = {name: store.request('GET', f'archive/{name}') for name in store.names()}
        server.kill()
        killed.append(sum('calibrations' in name for name in content))
        time.sleep(3.0)  # longer than the first pause, shorter than the second
        server.start()
        store.request('PUT', 'archive')
        for name, data in content.items():
            store.request('PUT', f'archive/{urllib.parse.quote(name)}', data)

    thread = threading.Thread(target=kill_and_restart)
    thread.start()
    done = store.trend(workers=1, AWS_ENDPOINT_URL=server.url)
    thread.join()
    assert '6 new, 0 known before, 0 failed' in done.stdout and done.stderr == ''
    assert killed and 2 <= killed[0] < 6
    assert store.bags_in_table() == store.kept() == [f's3://archive/fleet/{k}' for k in range(6)]
    assert '0 new, 6 known before, 0 failed' in store.trend().stdout
