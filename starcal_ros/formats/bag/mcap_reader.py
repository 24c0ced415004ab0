# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Reader of the intact messages of an MCAP file, which may be damaged.

A chunk with a wrong checksum is skipped.  If the bytes between chunks are damaged, reading
continues at the next chunk listed in the summary; if the first chunk with the topic names is lost,
the names come from the summary.  Lost messages are counted from the summary or, without one, from
the indexes after each chunk.  A truncated file has no summary and is read up to its end.
"""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import io
import os
from pathlib import Path
import struct
from typing import Any, IO
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, MessageIndex, Schema
from mcap.stream_reader import get_chunk_data_stream, StreamReader
from mcap.summary import Summary

from starcal_ros.untrusted import regular_file

Damage = Callable[[str], None]

MAGIC = b'\x89MCAP0\r\n'
_FOOTER = struct.Struct('<BQQQI')  # kind, length, start of summary and of its offsets, checksum
_RECORD = struct.Struct('<BQ')  # kind, length
_MESSAGE = struct.Struct('<HIQQ')  # channel, sequence, times of log and publication
# Damaged bytes are parsed as an arbitrary record, so the exceptions have no common base class.
_DAMAGE_ERRORS = (McapError, ValueError, struct.error, KeyError, OverflowError, MemoryError)


@dataclass(frozen=True)
class RawMessage:
    """One recorded message; ``view`` is serialised CDR with its header, part of a chunk."""

    topic: str
    type_name: str
    definition: str
    log_time_ns: int
    view: memoryview

    @property
    def data(self) -> bytes:
        """A copy of the message as bytes, because middleware does not accept a view."""
        return bytes(self.view)


def read_summary(file: Path) -> Summary | None:
    """Summary at the end of a file, empty if none was written; None if missing or damaged."""
    with regular_file(file) as stream:
        # The exceptions of a damaged summary have no common base class.
        try:
            stream.seek(-(_FOOTER.size + len(MAGIC)), os.SEEK_END)
            tail = stream.read()
            _, _, start, _, checksum = _FOOTER.unpack_from(tail)
            if tail[0] != Opcode.FOOTER or tail[_FOOTER.size :] != MAGIC:
                return None
            if checksum:
                stream.seek(start or stream.tell() - len(tail))
                covered = stream.read()[: -(len(MAGIC) + 4)]
                if zlib.crc32(covered) != checksum:
                    return None
            stream.seek(0)
            return make_reader(stream).get_summary() or Summary()
        except Exception:
            return None


def read_messages(
    file: Path, wanted: frozenset[str] | None, on_damage: Damage
) -> Iterator[RawMessage]:
    """Intact messages of the wanted topics (None: all), in file order."""
    summary = read_summary(file)
    known = summary or Summary()
    schemas: dict[int, Schema] = dict(known.schemas)
    channels: dict[int, Channel] = dict(known.channels)
    found: Counter[int] = Counter()
    pieces = _Pieces(file, known, on_damage)
    for record in pieces:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            found[record.channel_id] += 1
            channel = channels.get(record.channel_id)
            schema = schemas.get(channel.schema_id) if channel else None
            if channel is None or schema is None or channel.message_encoding != 'cdr':
                continue  # its channel was in a damaged chunk, or it is not a ROS 2 message
            if wanted is None or channel.topic in wanted:
                definition = schema.data.decode(errors='replace')
                view = memoryview(record.data)
                yield RawMessage(channel.topic, schema.name, definition, record.log_time, view)
    if summary is None and pieces.complete:
        pieces.report('truncated, or its summary is damaged; all messages before it were read')
    if known.statistics is not None:
        expected = Counter(known.statistics.channel_message_counts)
        lost = expected - found
    else:
        expected, lost = found + pieces.lost, pieces.lost
    nameless = {number: n for number, n in found.items() if number not in channels}
    if lost or nameless:
        pieces.report(_loss(lost, expected, channels, nameless))


def _loss(
    lost: Counter[int],
    expected: Counter[int],
    channels: dict[int, Channel],
    nameless: dict[int, int],
) -> str:
    """Lost messages by topic, e.g. ``lost 3 of 16 on /image``."""
    parts = []
    for number, n in sorted(lost.items()):
        name = channels[number].topic if number in channels else f'channel {number}'
        parts.append(f'{n} of {expected[number]} on {name}')
    if nameless:
        parts.append(f'{sum(nameless.values())} of unknown topics')
    return 'lost ' + ', '.join(parts)


class _Pieces:
    """
    Schemas, channels and messages of a file, inside and outside chunks.

    ``complete`` is True once the end of the data was reached; ``lost`` counts the messages in
    damaged chunks by channel, from the indexes after those chunks.
    """

    def __init__(self, file: Path, summary: Summary, on_damage: Damage) -> None:
        self.complete = False
        self.lost: Counter[int] = Counter()
        self._file = file
        self._on_damage = on_damage
        self._starts = sorted(index.chunk_start_offset for index in summary.chunk_indexes)
        self._has_chunks = bool(self._starts)
        self._reported = False

    def report(self, text: str) -> None:
        """Report damage of this file."""
        self._reported = True
        self._on_damage(f'{self._file}: {text}')

    def __iter__(self) -> Iterator[McapRecord]:
        with regular_file(self._file) as stream:
            start: int | None = 0
            while start is not None:
                stream.seek(start)
                start = yield from self._run(stream, start)

    def _run(self, stream: IO[bytes], start: int) -> Any:
        """Pieces after an offset; returns the offset to continue at after damage, or None."""
        size = os.fstat(stream.fileno()).st_size
        reader = StreamReader(
            stream,
            skip_magic=start > 0,
            emit_chunks=True,
            validate_crcs=True,
            record_size_limit=size,
        )
        read_to, chunk_is_sound = start, True
        try:
            for record in reader.records:
                passed = self._start_after(read_to)
                if passed is not None and passed < stream.tell():
                    # A wrong length or an unknown opcode has skipped the start of a chunk.
                    self.report(f'damaged after byte {read_to} of {size}')
                    return passed
                read_to = stream.tell()
                if isinstance(record, Chunk):
                    self._has_chunks = True
                    chunk_is_sound = yield from self._of_chunk(record, read_to)
                elif isinstance(record, MessageIndex):
                    if not chunk_is_sound:
                        self.lost[record.channel_id] += len(record.records)
                elif isinstance(record, DataEnd):
                    self.complete = True
                    return None
                elif not self._has_chunks or isinstance(record, (Schema, Channel)):
                    yield record
                elif isinstance(record, Message):
                    # Recorders put all messages into chunks or none, so these bytes are damaged.
                    self.report(f'damaged after byte {read_to} of {size}')
                    return self._start_after(read_to)
            self.report(f'damaged before byte {read_to} of {size}: no end-of-data record')
        except _DAMAGE_ERRORS as error:
            following = self._start_after(read_to)
            if following is None and not self._reported:
                at_end = isinstance(error, (EndOfFile, RecordLengthLimitExceeded))
                kind = 'truncated' if at_end or stream.tell() >= size else 'damaged'
                self.report(
                    f'{kind} after byte {read_to} of {size} ({type(error).__name__});'
                    ' all messages before it were read'
                )
            elif following is not None:
                self.report(f'damaged after byte {read_to} of {size} ({type(error).__name__})')
            return following
        return None

    def _start_after(self, offset: int) -> int | None:
        """Offset of the first chunk in the summary after an offset."""
        k = bisect.bisect_right(self._starts, offset)
        return self._starts[k] if k < len(self._starts) else None

    def _of_chunk(self, chunk: Chunk, end: int) -> Any:
        """Records of a chunk; returns False if its checksum or compression is invalid."""
        try:
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        except Exception as error:
            self.report(f'skipped the damaged chunk that ends at byte {end}: {error}')
            return False
        yield from _inside(stream.read(length))
        return True


def _inside(data: bytes) -> Iterator[McapRecord]:
    """
    Records of a decompressed chunk.

    The bytes of a message are a view: copying each image would hold Python's lock and stall the
    other thread.
    """
    view = memoryview(data)
    start = 0
    while start < len(data):
        opcode, size = _RECORD.unpack_from(data, start)
        start, end = start + _RECORD.size, start + _RECORD.size + size
        if end > len(data) or (opcode == Opcode.MESSAGE and size < _MESSAGE.size):
            raise EndOfFile
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            content = view[start + _MESSAGE.size : end]
            yield Message(channel, log_time, content, publish_time, sequence)  # type: ignore[arg-type]
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(io.BytesIO(view[start:end])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(io.BytesIO(view[start:end])))
        start = end
