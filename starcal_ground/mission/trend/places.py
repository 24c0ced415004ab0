# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Files by path or by any URL of fsspec (``s3://``, ``gs://``, ``file://``): listed and fetched.

A local file is named by its absolute path.  Whatever fails is an `OSError`, of an object store
too, so callers tell a place that cannot be reached from a file that is bad.  The client of a store
tries again where a connection is dropped; here all its attempts together have a limit of time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass
import errno
import os
from pathlib import Path
import posixpath
import tempfile
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_ETAGS = ('ETag', 'etag', 'md5Hash')  # names in S3, Google and Azure
_TIMES = ('LastModified', 'last_modified', 'updated', 'mtime', 'created')
_LONGEST_REASON = 200
_TOGETHER = 100_000  # files that are listed at once: 0.2 GB in the clients of stores
ANSWER_S = 60.0  # for a request and all its repetitions
LIST_S = 300.0  # for a list: a hundred requests in turn
_SLOWEST = 64 * 1024  # bytes a second of the largest file


@dataclass(frozen=True, slots=True)
class Entry:
    """
    A file below a root; ``name`` is its path from there.

    ``identity`` changes with the content: the etag, else size and time, as far as they are known.
    ``size`` is -1 for a file that cannot be read.
    """

    url: str
    name: str
    size: int
    identity: str


def absolute(place: str) -> str:
    """The place as every process finds it: an absolute path, or the URL."""
    if is_remote(place):
        return place.rstrip('/')
    return os.path.abspath(place.removeprefix('file://'))


def is_remote(place: str) -> bool:
    """True for a URL that is not one of this machine's files."""
    return '://' in place and not place.startswith('file://')


def join(folder: str, name: str) -> str:
    """A place below a folder; the folder itself for an empty name."""
    return posixpath.join(folder, name) if name else folder


def listings(root: str) -> Iterator[list[Entry]]:
    """
    Files below a root in lists, each with all files of a folder or none; raises OSError.

    A local list is that of one folder.  A request to a store lists 1000 files below one folder, so
    a list is that of all files below a subfolder of the root (of the first folder with several),
    or of all files below the root where they are fewer than about 100,000.
    """
    if not is_remote(root):
        for folder, folders, files in os.walk(root):
            folders.sort()
            # A folder in place of a calibration is a file that cannot be read.
            files += (name for name in folders if name.endswith('.json'))
            yield _local_entries(root, folder, sorted(files))
        return
    with _remote(root) as (fs, base):
        fs.invalidate_cache()
        limits = {'detail': True, **_within(fs, LIST_S)}
        top, infos = base, fs.ls(base, **limits)
        # The marker of an empty folder has the name of the folder.
        while [i['type'] for i in infos] == ['directory'] and len(infos[0]['name']) > len(top):
            top = infos[0]['name']
            infos = fs.ls(top, **limits)
        below = [info['name'] for info in infos if info['type'] == 'directory']
        if not below or len(below) * len(fs.find(below[0], **limits)) < _TOGETHER:
            yield _remote_entries(fs, base, fs.find(top, **limits))
            return
        files_here = {info['name']: info for info in infos if info['type'] != 'directory'}
        yield _remote_entries(fs, base, files_here)
        for folder in below:
            fs.invalidate_cache()  # it keeps each listing
            yield _remote_entries(fs, base, fs.find(folder, **limits))


def exists(place: str) -> bool:
    """True for a file or a folder; raises OSError."""
    if not is_remote(place):
        return os.path.exists(place)
    with _remote(place) as (fs, path):
        return bool(fs.exists(path, **_within(fs, ANSWER_S)))


def is_answered(url: str) -> bool:
    """Return True if a store says now whether it has a file."""
    try:
        with _remote(url) as (fs, path):
            fs.invalidate_cache()
            fs.exists(path, **_within(fs, ANSWER_S))
    except OSError:
        return False
    return True


@contextlib.contextmanager
def fetched(url: str, files: Sequence[str], size_bytes: int) -> Iterator[Path]:
    """
    The path of a file or folder of which ``files`` are read, while the block runs.

    Remote files are copied into a temporary folder of this machine, since readers of bags seek
    and are C code; local ones are read where they are.
    """
    if not is_remote(url):
        yield Path(url)
        return
    above = posixpath.dirname(url)
    with tempfile.TemporaryDirectory(prefix='starcal-') as folder:
        with _remote(url) as (fs, _):
            limit = _within(fs, ANSWER_S + size_bytes / _SLOWEST)
            for file in files:
                here = Path(folder, posixpath.relpath(file, above))
                here.parent.mkdir(parents=True, exist_ok=True)
                fs.get_file(fs._strip_protocol(file), str(here), **limit)
        yield Path(folder, posixpath.basename(url))


def _local_entries(root: str, folder: str, names: Sequence[str]) -> list[Entry]:
    entries = []
    for path in (os.path.join(folder, name) for name in names):
        try:
            status = os.stat(path)
            size, identity = status.st_size, f'{status.st_size} {status.st_mtime_ns}'
        except OSError as error:
            size, identity = -1, f'error {error.errno}'
        entries.append(Entry(path, os.path.relpath(path, root), size, identity))
    return entries


def _remote_entries(
    fs: AbstractFileSystem, base: str, infos: Mapping[str, dict[str, Any]]
) -> list[Entry]:
    return [
        Entry(
            fs.unstrip_protocol(path),
            posixpath.relpath(path, base),
            int(info['size']),
            _identity(info),
        )
        for path, info in sorted(infos.items())
    ]


def _identity(info: dict[str, Any]) -> str:
    etag = next((str(info[name]) for name in _ETAGS if info.get(name)), '')
    time = next((str(info[name]) for name in _TIMES if info.get(name)), '')
    return etag or f'{info["size"]} {time}'


@contextlib.contextmanager
def _remote(url: str) -> Iterator[tuple[AbstractFileSystem, str]]:
    """The file system of a URL and the path there; failures of its client become OSError."""
    import fsspec.exceptions

    try:
        yield fsspec.core.url_to_fs(url)
    except fsspec.exceptions.FSTimeoutError as error:
        raise OSError(errno.ETIMEDOUT, 'no answer in time', url) from error
    # Each client of an object store has exceptions of its own, or leaves out the reason.
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise
        if isinstance(cause := error.__cause__, ModuleNotFoundError):  # the client
            raise ModuleNotFoundError(str(cause), name=cause.name) from error
        code = errno.ENOENT if isinstance(error, FileNotFoundError) else errno.EIO
        words = ' '.join(f'{type(error).__name__}: {error}'.split())
        raise OSError(code, words[:_LONGEST_REASON], url) from error


def _within(fs: AbstractFileSystem, limit_s: float) -> dict[str, float]:
    """Argument that limits a request, for the clients that take one: those of object stores."""
    from fsspec.asyn import AsyncFileSystem

    return {'timeout': limit_s} if isinstance(fs, AsyncFileSystem) else {}
