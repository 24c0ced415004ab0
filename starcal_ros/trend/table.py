# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The Parquet table of a trend: a folder of files, each written whole, that grows without a rewrite.

A crash leaves complete files only.  Rows are unique by their key: one that was written twice, by a
crash between writing a merged file and removing its parts, counts once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
import dataclasses
from pathlib import Path
from typing import Any, get_type_hints
import uuid

import pyarrow as pa
import pyarrow.parquet as pq

from starcal_ros.errors import ProductError
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.products.files import write_atomically
from starcal_ros.products.json_codec import from_json, to_json
from starcal_ros.trend.rows import Row
from starcal_ros.untrusted import read_bytes

TABLE_FOLDER = 'trend.parquet'
_BATCH = 16  # rows in a part: what a crash can lose, a few seconds of work
_MERGE = 64  # parts from which they are merged into one file
_MOST_BYTES = 256 * 2**20  # of a file; a row has 0.5 kB
_MOST_VALUES = 2**25  # of a file, repeated ones counted, which compress to nothing
_TYPES: dict[Any, pa.DataType] = {
    str: pa.string(),
    int: pa.int64(),
    bool: pa.bool_(),
    float: pa.float64(),
    tuple[str, ...]: pa.list_(pa.string()),
    tuple[float, ...]: pa.list_(pa.float64()),
}
SCHEMA = pa.schema(
    [
        (name, _TYPES[kind])
        for name, kind in get_type_hints(Row).items()
        if name in {field.name for field in dataclasses.fields(Row)}
    ]
)


class Table:
    """
    The table in a folder; rows are added one by one and written in batches.

    Use it in a ``with`` statement: its end writes the last batch.

    Raises
    ------
    ProductError
        When a file of the table cannot be read or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / TABLE_FOLDER
        self._pending: list[Row] = []
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ProductError(f'{self.folder}: cannot be created: {error.strerror}') from error
        self._keys = {row.key for row in self.rows()}

    def __enter__(self) -> Table:
        """Return the table."""
        return self

    def __exit__(self, *_: object) -> None:
        """Write the rows that are held in memory."""
        self.flush()

    def __contains__(self, key: object) -> bool:
        """Whether a row with a key was added."""
        return key in self._keys

    def add(self, row: Row) -> None:
        """Add a row, unless there is one with its key."""
        if row.key in self._keys:
            return
        self._keys.add(row.key)
        self._pending.append(row)
        if len(self._pending) >= _BATCH:
            self.flush()

    def flush(self) -> None:
        """Write the rows that are held in memory, and merge the parts if there are many."""
        if self._pending:
            self._write(self._pending)
            self._pending = []
        if len(self._parts()) >= _MERGE:
            self._merge(self.rows())

    def forget_failed(self, but: Collection[str] = ()) -> None:
        """Remove the rows of failures, but those of some keys that this version has tried."""
        software = f'starcal {software_version()}'
        rows = self.rows()
        kept = [
            row for row in rows if not row.error or (row.key in but and row.software == software)
        ]
        if len(kept) < len(rows):
            self._merge(kept)
            self._keys = {row.key for row in kept}

    def rows(self) -> list[Row]:
        """All rows on disk, in order of time."""
        found: dict[str, Row] = {}
        for part in self._parts():
            try:
                for row in _rows_of(part):
                    found.setdefault(row.key, row)
            # The exceptions of damaged Parquet have no common base class.
            except Exception as error:
                words = ' '.join(str(error).split())[:120]
                raise ProductError(
                    f'{part}: not a table of starcal trend: {words}; remove the file to make its '
                    'rows again'
                ) from error
        return sorted(found.values(), key=lambda row: (row.time_ns, row.key))

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob('*.parquet'))

    def _merge(self, rows: Iterable[Row]) -> None:
        before = self._parts()
        self._write(list(rows))
        for part in before:
            part.unlink()

    def _write(self, rows: list[Row]) -> None:
        if not rows:
            return
        memory = pa.BufferOutputStream()
        pq.write_table(pa.Table.from_pylist([to_json(row) for row in rows], SCHEMA), memory)
        path = self.folder / f'{uuid.uuid4().hex}.parquet'
        write_atomically(path, memory.getvalue().to_pybytes())


def _rows_of(part: Path) -> Iterator[Row]:
    """Rows of a file, which need not be one of ours."""
    file = pq.ParquetFile(pa.BufferReader(read_bytes(part, _MOST_BYTES)))
    groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
    if sum(g.column(k).num_values for g in groups for k in range(g.num_columns)) > _MOST_VALUES:
        raise ValueError(f'more than {_MOST_VALUES} values')
    for batch in file.iter_batches(_BATCH):
        for content in batch.to_pylist():
            yield from_json(Row, {name: _written(value) for name, value in content.items()})


def _written(value: Any) -> Any:
    """A value as `to_json` writes it: NaN is null; earlier versions wrote it as it is."""
    if isinstance(value, list):
        return [_written(item) for item in value]
    return None if value != value else value
