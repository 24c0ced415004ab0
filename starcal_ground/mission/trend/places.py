# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Files by path or by any URL of fsspec (``s3://``, ``gs://``, ``file://``): listed and fetched.

A local file is named by its absolute path.  Whatever fails is an `OSError`, of an object store
too, so callers tell a place that cannot be reached from a file that is bad.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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

_IDENTITIES = (  # S3, Google and Azure name them differently
    *('ETag', 'etag', 'md5Hash'),
    *('LastModified', 'last_modified', 'updated', 'mtime', 'created'),
)
_LONGEST_REASON = 200
# The client of a store repeats a request 25 times: where nothing answers, for half an hour.
ANSWER_S = 300.0
_SLOWEST = 64 * 1024  # bytes a second of the largest file


@dataclass(frozen=True, slots=True)
class Entry:
    """
    A file below a root; ``name`` is its path from there.

    ``identity`` changes with the content: size, and etag or time where it is known.
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


def listings(root: str) -> Iterator[list[Entry]]:
    """Files below a root in lists, each with all files of a folder or none; raises OSError."""
    if not is_remote(root):
        for folder, folders, files in os.walk(root):
            folders.sort()
            # A folder in place of a calibration is a file that cannot be read.
            files += (name for name in folders if name.endswith('.json'))
            yield [_local_entry(root, os.path.join(folder, name)) for name in sorted(files)]
        return
    with _store(root) as (fs, base):
        fs.invalidate_cache()
        infos = fs.find(base, detail=True, **_within(fs)).items()
    yield [
        Entry(fs.unstrip_protocol(path), posixpath.relpath(path, base), info['size'], _known(info))
        for path, info in sorted(infos)
    ]


def exists(place: str) -> bool:
    """True for a file or a folder; raises OSError."""
    if not is_remote(place):
        return os.path.exists(place)
    with _store(place) as (fs, path):
        fs.invalidate_cache()
        return bool(fs.exists(path, **_within(fs)))


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
    with tempfile.TemporaryDirectory(prefix='starcal-') as folder:
        here = [
            os.path.join(folder, posixpath.relpath(file, posixpath.dirname(url))) for file in files
        ]
        with _store(url) as (fs, _):
            fs.get([*map(fs._strip_protocol, files)], here, **_within(fs, size_bytes))
        yield Path(folder, posixpath.basename(url))


def _local_entry(root: str, path: str) -> Entry:
    try:
        status = os.stat(path)
        size, identity = status.st_size, f'{status.st_size} {status.st_mtime_ns}'
    except OSError as error:
        size, identity = -1, f'error {error.errno}'
    return Entry(path, os.path.relpath(path, root), size, identity)


def _known(info: dict[str, Any]) -> str:
    return f'{info["size"]} {next((info[name] for name in _IDENTITIES if info.get(name)), "")}'


@contextlib.contextmanager
def _store(url: str) -> Iterator[tuple[AbstractFileSystem, str]]:
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
        words = ' '.join(f'{type(error).__name__}: {error}'.split())
        raise OSError(errno.EIO, words[:_LONGEST_REASON], url) from error


def _within(fs: AbstractFileSystem, size_bytes: int = 0) -> dict[str, float]:
    """Argument that limits a request, for the clients that take one: those of object stores."""
    from fsspec.asyn import AsyncFileSystem

    limit_s = ANSWER_S + size_bytes / _SLOWEST
    return {'timeout': limit_s} if isinstance(fs, AsyncFileSystem) else {}
