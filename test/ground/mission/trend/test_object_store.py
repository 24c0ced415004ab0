# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The command on bags in a store: the client of S3 against a server that answers, or does not."""

from collections.abc import Iterator
import gc
import hashlib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
import re
import shutil
import threading
import urllib.parse
from xml.sax.saxutils import escape

import fsspec
from mission_files import TINY  # type: ignore[import-not-found]
import pytest
from starcal_tool import assert_refused, Starcal  # type: ignore[import-not-found]
from trend_rows import write  # type: ignore[import-not-found]

from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.trend_table import Row, Table

s3fs = pytest.importorskip('s3fs')  # of requirements/dev.txt; not in the oldest versions
# What was never answered warns when it is collected, which is in the test itself.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings('ignore::ResourceWarning')]

_FLEET = 's3://archive/fleet'
# A sound answer takes milliseconds.
_CLIENT = {'connect_timeout': 1.0, 'read_timeout': 0.5, 'retries': {'max_attempts': 0}}
_CODES = {403: 'AccessDenied', 404: 'NoSuchKey', 503: 'SlowDown'}
_TIME = '2026-01-01T00:00:00.000Z'


class Store(ThreadingHTTPServer):
    """
    A server with objects in the bucket `archive`, which notes requests.

    A request whose line has a pattern of ``faults`` is refused with that status of HTTP; 0 drops
    its connection, -1 never answers, -2 sends half of the content.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(('127.0.0.1', 0), Handler)
        self.url = f'http://127.0.0.1:{self.server_port}'
        self.objects: dict[str, bytes] = {}
        self.faults: dict[str, int] = {}
        self.requests: list[str] = []
        self.is_closing = threading.Event()

    def reset(self, folder: Path) -> None:
        """The files below a folder, and no fault."""
        self.faults, self.requests = {}, []
        self.objects = {
            f'fleet/{path.relative_to(folder)}': path.read_bytes()
            for path in folder.rglob('*')
            if path.is_file()
        }

    def handle_error(self, *_: object) -> None:
        """Say nothing where a client has left."""


class Handler(BaseHTTPRequestHandler):
    """Lists, sizes and contents of objects as S3 answers; all else is an error."""

    protocol_version = 'HTTP/1.1'
    server: Store

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        store, line = self.server, urllib.parse.unquote(f'{self.command} {self.path}')
        store.requests.append(line)
        fault = next((n for pattern, n in store.faults.items() if re.search(pattern, line)), 200)
        if fault == -1:
            store.is_closing.wait()
        if fault < 1 and fault != -2:
            self.close_connection = True
            return
        url = urllib.parse.urlsplit(self.path)
        bucket, _, key = urllib.parse.unquote(url.path).lstrip('/').partition('/')
        query = dict(urllib.parse.parse_qsl(url.query))
        if fault >= 300:
            self._answer(fault, f'<Error><Code>{_CODES[fault]}</Code></Error>'.encode())
        elif bucket != 'archive':
            self._answer(404, b'<Error><Code>NoSuchBucket</Code></Error>')
        elif query.get('list-type') == '2':
            self._answer(200, self._list(query.get('prefix', ''), query.get('delimiter', '')))
        elif key in store.objects:
            self._answer(200, store.objects[key], is_cut=fault == -2)
        else:
            self._answer(404, b'<Error><Code>NoSuchKey</Code></Error>')

    def _list(self, prefix: str, delimiter: str) -> bytes:
        """ListObjectsV2: objects below a prefix, and folders up to the next delimiter."""
        folders, lines = set(), []
        for key, content in self.server.objects.items():
            head, found, _ = key.removeprefix(prefix).partition(delimiter or '\n')
            if key.startswith(prefix) and found:
                folders.add(f'{prefix}{head}{delimiter}')
            elif key.startswith(prefix):
                lines.append(
                    f'<Contents><Key>{escape(key)}</Key><LastModified>{_TIME}</LastModified>'
                    f'<ETag>"{hashlib.md5(content).hexdigest()}"</ETag>'
                    f'<Size>{len(content)}</Size></Contents>'
                )
        lines += [f'<CommonPrefixes><Prefix>{f}</Prefix></CommonPrefixes>' for f in folders]
        count = f'<KeyCount>{len(lines)}</KeyCount><IsTruncated>false</IsTruncated>'
        return f'<ListBucketResult>{count}{"".join(lines)}</ListBucketResult>'.encode()

    def _answer(self, status: int, content: bytes, is_cut: bool = False) -> None:
        self.send_response(status)
        self.send_header('Content-Length', str(len(content)))
        self.send_header('Content-Type', 'application/xml')
        self.send_header('ETag', f'"{hashlib.md5(content).hexdigest()}"')
        self.end_headers()
        if self.command == 'GET':
            self.wfile.write(content[: len(content) // 2] if is_cut else content)
        self.close_connection = is_cut

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture(scope='module')
def server() -> Iterator[Store]:
    made = Store()
    threading.Thread(target=made.serve_forever, daemon=True).start()
    with pytest.MonkeyPatch.context() as patch:
        settings = {'ACCESS_KEY_ID': 'a', 'SECRET_ACCESS_KEY': 'b', 'ENDPOINT_URL': made.url}
        for name, value in {**settings, 'DEFAULT_REGION': 'us-east-1'}.items():
            patch.setenv(f'AWS_{name}', value)
        patch.setitem(fsspec.config.conf, 's3', {'config_kwargs': _CLIENT})
        patch.setattr(s3fs.S3FileSystem, 'retries', 2)
        fleet.exists(_FLEET)
        yield made
    made.is_closing.set()
    made.shutdown()
    made.server_close()
    s3fs.S3FileSystem.clear_instance_cache()
    gc.collect()


@pytest.fixture
def store(server: Store, tmp_path: Path) -> Iterator[Store]:
    """The server with two calibrations."""
    for k in range(2):
        write(tmp_path / 'there' / str(k), k)
    server.reset(tmp_path / 'there')
    yield server
    gc.collect()


@pytest.fixture
def trend(tmp_path: Path, starcal: Starcal) -> Starcal:
    given = ['-o', tmp_path / 'out', '--params', TINY / 'params.yaml']
    return lambda *more, root=_FLEET: starcal('trend', root, *given, *more)


def test_a_bag_is_fetched_by_a_worker_and_read_once(store, few_images, tmp_path, trend) -> None:
    shutil.copytree(few_images, tmp_path / 'bags' / '0')
    store.reset(tmp_path / 'bags')
    assert '1 new, 0 known, 0 failed' in trend('--workers', 1).out
    assert sum('GET' in line and 'mcap' in line for line in store.requests) == 1
    assert [row.path for row in Table(tmp_path / 'out').rows()] == [f'{_FLEET}/0']
    store.requests.clear()
    assert '0 new, 1 known, 0 failed' in trend().out
    assert not any('mcap' in line for line in store.requests)


PLACES = {  # faults of requests, root, what the one line names
    'no bucket': ({}, 's3://none/fleet', 's3://none/fleet: no such folder'),
    'no folder': ({}, 's3://archive/other', 's3://archive/other: no such folder'),
    'no rights': ({'': 403}, _FLEET, 'cannot be read: PermissionError: '),
    'drops each connection': ({'': 0}, _FLEET, f'{_FLEET}: cannot be read: ConnectionClosed'),
    'never answers': ({'': -1}, _FLEET, f'{_FLEET}: cannot be read: ReadTimeoutError: '),
    'never lists': ({'list-type': -1}, _FLEET, f'{_FLEET}: cannot be read: ReadTimeoutError: '),
}


@pytest.mark.parametrize('case', PLACES)
def test_a_store_that_cannot_be_listed_is_one_line(store, trend, case) -> None:
    store.faults, root, words = PLACES[case]
    assert_refused(trend(root=root), words)


FAULTS = {  # of requests of one calibration, and the reason of its row
    'dropped': ({'GET /archive/fleet/0/': 0}, 'ConnectionClosedError: '),
    'never answered': ({'GET /archive/fleet/0/': -1}, 'ReadTimeoutError: '),
    'cut off': ({'GET /archive/fleet/0/': -2}, ''),
    'forbidden': ({'/archive/fleet/0/': 403}, 'PermissionError: '),
    'overloaded': ({'GET /archive/fleet/0/': 503}, 'SlowDown'),
    'gone': ({'/archive/fleet/0/': 404}, ''),
}


@pytest.mark.parametrize('fault', FAULTS)
def test_a_file_that_cannot_be_fetched_fails_and_passes(store, tmp_path, trend, fault) -> None:
    store.faults, reason = FAULTS[fault]
    status, out, _ = trend()
    assert status == 0
    assert '1 new, 0 known, 1 failed' in out
    (line,) = [line for line in out.splitlines() if line.startswith('failed: ')]
    assert f'{_FLEET}/0/calibration.json: ' in line
    assert 'cannot be read: ' in line and reason in line
    store.faults = {}
    assert '1 new, 1 known, 0 failed' in trend().out
    assert [row.error for row in Table(tmp_path / 'out').rows()] == ['', '']


def test_a_store_that_falls_silent_ends_the_run(store, tmp_path, trend, monkeypatch) -> None:
    """A file that a store does not give, where it gives others, holds up no run."""
    compute = fleet.compute

    def while_silent(task: fleet.Task) -> Row:
        store.faults = {'': -1}  # every request
        return compute(task)

    with monkeypatch.context() as patch:
        patch.setattr(fleet, 'compute', while_silent)
        assert_refused(trend(), f'{_FLEET}: cannot be read: ReadTimeoutError: ')
    assert Table(tmp_path / 'out').rows() == []
    store.faults = {'GET /archive/fleet/0/': -1}
    assert '1 new, 0 known, 1 failed' in trend().out
    store.faults = {}
    assert '1 new, 1 known, 0 failed' in trend().out
