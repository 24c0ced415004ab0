# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Files by path or by any URL of fsspec (``s3://``, ``gs://``, ``file://``): listed, read, written.

A local file is named by its absolute path.  Whatever fails is an `OSError`, of an object store
too, so callers tell a place that cannot be reached from a file that is bad.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass
import errno
import itertools
import os
from pathlib import Path
import posixpath
import tempfile
from typing import Any, TYPE_CHECKING

from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.untrusted import read_bytes

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_ETAGS = ('ETag', 'etag', 'md5Hash')  # of S3, Google and Azure
_TIMES = ('LastModified', 'last_modified', 'updated', 'mtime', 'created')
_LONGEST_REASON = 200
_TOGETHER = 100_000  # files that are listed at once: 0.2 GB in the clients of stores
_OBJECT_STORES = {'s3', 'gs', 'abfs'}


@dataclass(frozen=True, slots=True)
class Entry:
    """
    A file below a root; ``name`` is its path from there.

    ``identity`` changes with the content: the etag, else size and time; empty without either.
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


def entries(root: str) -> list[Entry]:
    """Files below a root, in order of their names; raises OSError."""
    if not is_remote(root):
        return sorted(itertools.chain(*listings(root)), key=lambda entry: entry.name)
    with _remote(root) as (fs, base):
        fs.invalidate_cache()
        return _remote_entries(fs, base, fs.find(base, detail=True))


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
            # A folder in place of a calibration or a table is a file that cannot be read.
            files += (name for name in folders if name.endswith(('.json', '.parquet')))
            yield _local_entries(root, folder, sorted(files))
        return
    with _remote(root) as (fs, base):
        fs.invalidate_cache()
        top, found = base, fs.ls(base, detail=True)
        # The marker of an empty folder has the name of the folder.
        while [i['type'] for i in found] == ['directory'] and len(found[0]['name']) > len(top):
            top = found[0]['name']
            found = fs.ls(top, detail=True)
        below = [info['name'] for info in found if info['type'] == 'directory']
        if not below or len(below) * len(fs.find(below[0])) < _TOGETHER:
            yield _remote_entries(fs, base, fs.find(top, detail=True))
            return
        files_here = {info['name']: info for info in found if info['type'] != 'directory'}
        yield _remote_entries(fs, base, files_here)
        for below_one in below:
            fs.invalidate_cache()  # it keeps each listing
            yield _remote_entries(fs, base, fs.find(below_one, detail=True))


def make_folder(folder: str) -> None:
    """
    Make a folder where there is none; raises OSError.

    A remote one is written to, so that a wrong bucket or missing rights end a run at its start.
    """
    if not is_remote(folder):
        os.makedirs(folder, exist_ok=True)
        return
    probe = join(folder, '_probe')
    write(probe, b'')
    with contextlib.suppress(FileNotFoundError):  # another run has removed it
        remove(probe)


def exists(place: str) -> bool:
    """True for a file or a folder; raises OSError."""
    if not is_remote(place):
        return os.path.exists(place)
    with _remote(place) as (fs, path):
        return bool(fs.exists(path))


def read(url: str, most_bytes: int) -> bytes:
    """
    Content of a file.

    Raises OSError when it cannot be read. Raises ValueError in one line, for one that is not
    regular or is too large.
    """
    if not is_remote(url):
        return read_bytes(Path(url), most_bytes)
    with _remote(url) as (fs, path):
        content = fs.cat_file(path) if fs.size(path) <= most_bytes else None
    if content is None:
        raise ValueError(f'larger than {most_bytes // 1024} kB')
    return bytes(content)


def write(url: str, content: bytes) -> None:
    """Write a file whole, with the folders above it; raises OSError or ProductError."""
    if not is_remote(url):
        os.makedirs(os.path.dirname(url), exist_ok=True)
        write_atomically(Path(url), content)
        return
    with _remote(url) as (fs, path):
        # An object store has no folders, and would make the bucket of a mistyped URL.
        if not _OBJECT_STORES.intersection(_protocols(fs)):
            fs.makedirs(posixpath.dirname(path), exist_ok=True)
        fs.pipe_file(path, content)


def remove(url: str) -> None:
    """Remove a file; raises OSError."""
    if not is_remote(url):
        os.unlink(url)
        return
    with _remote(url) as (fs, path):
        fs.rm_file(path)


@contextlib.contextmanager
def fetched(url: str, files: Sequence[str]) -> Iterator[Path]:
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
            for file in files:
                here = Path(folder, posixpath.relpath(file, above))
                here.parent.mkdir(parents=True, exist_ok=True)
                fs.get_file(fs._strip_protocol(file), str(here))
        yield Path(folder, posixpath.basename(url))


def _local_entries(root: str, folder: str, names: Sequence[str]) -> list[Entry]:
    found = []
    for path in (os.path.join(folder, name) for name in names):
        try:
            status = os.stat(path)
            size, identity = status.st_size, f'{status.st_size} {status.st_mtime_ns}'
        except OSError as error:
            size, identity = -1, f'error {error.errno}'
        found.append(Entry(path, os.path.relpath(path, root), size, identity))
    return found


def _remote_entries(
    fs: AbstractFileSystem, base: str, found: Mapping[str, dict[str, Any]]
) -> list[Entry]:
    return [
        Entry(
            fs.unstrip_protocol(path),
            posixpath.relpath(path, base),
            int(info['size']),
            _identity(info),
        )
        for path, info in sorted(found.items())
    ]


def _identity(info: dict[str, Any]) -> str:
    etag = next((str(info[name]) for name in _ETAGS if info.get(name)), '')
    time = next((str(info[name]) for name in _TIMES if info.get(name)), '')
    return etag or (f'{info["size"]} {time}' if time else '')


@contextlib.contextmanager
def _remote(url: str) -> Iterator[tuple[AbstractFileSystem, str]]:
    """The file system of a URL and the path there; failures of its client become OSError."""
    import fsspec

    try:
        yield fsspec.core.url_to_fs(url)
    # Each client of an object store has exceptions of its own, or leaves out the reason.
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise
        code = errno.ENOENT if isinstance(error, FileNotFoundError) else errno.EIO
        raise OSError(code, _reason(error), url) from error


def _protocols(fs: AbstractFileSystem) -> tuple[str, ...]:
    return (fs.protocol,) if isinstance(fs.protocol, str) else tuple(fs.protocol)


def _reason(error: Exception) -> str:
    return ' '.join(f'{type(error).__name__}: {error}'.split())[:_LONGEST_REASON]
