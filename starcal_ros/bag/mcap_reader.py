"""
The messages of an MCAP file, as far as they are sound.

A chunk whose checksum fails is left out.  Where the bytes between chunks are damaged, reading goes
on at the next chunk that the summary knows; where the first chunk is lost, with it the names of
the topics, they are the summary's.  What is missing is counted by the summary, or by the indexes
that follow each chunk.  A file that was cut off has no summary: it is read up to the cut.
"""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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

Damage = Callable[[str], None]

MAGIC = b'\x89MCAP0\r\n'
_FOOTER = struct.Struct('<BQQQI')  # kind, length, start of summary and of its offsets, checksum
# Damage shows as whatever the bytes after it are taken for: no common base.
_DAMAGE_ERRORS = (McapError, ValueError, struct.error, KeyError, OverflowError, MemoryError)


@dataclass(frozen=True)
class RawMessage:
    """One message as the bag holds it: ``data`` is serialised CDR, header included."""

    topic: str
    type_name: str
    definition: str
    log_time_ns: int
    data: bytes


def read_summary(file: Path) -> Summary | None:
    """
    The summary at the end of a file, empty where the file was written without one.

    None where it is damaged, or was never reached: a checksum is held against what is read.
    """
    with file.open('rb') as stream:
        # What a damaged summary raises has no common base.
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
    """Sound messages of the wanted topics (None: all), in the order of the file."""
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
                continue  # its channel went with a damaged chunk, or it is not ROS 2's
            if wanted is None or channel.topic in wanted:
                definition = schema.data.decode(errors='replace')
                yield RawMessage(
                    channel.topic, schema.name, definition, record.log_time, record.data
                )
    if summary is None and pieces.complete:
        pieces.tell('cut off or damaged in its summary; what stands before it was read')
    if known.statistics is not None:
        expected = Counter(known.statistics.channel_message_counts)
        lost = expected - found
    else:
        expected, lost = found + pieces.lost, pieces.lost
    nameless = {number: n for number, n in found.items() if number not in channels}
    if lost or nameless:
        pieces.tell(_loss(lost, expected, channels, nameless))


def _loss(
    lost: Counter[int],
    expected: Counter[int],
    channels: dict[int, Channel],
    nameless: dict[int, int],
) -> str:
    """Messages lost by topic, as ``lost 3 of 16 on /image``."""
    parts = []
    for number, n in sorted(lost.items()):
        name = channels[number].topic if number in channels else f'channel {number}'
        parts.append(f'{n} of {expected[number]} on {name}')
    if nameless:
        parts.append(f'{sum(nameless.values())} whose topic went with the damage')
    return 'lost ' + ', '.join(parts)


class _Pieces:
    """
    Schemas, channels and messages of a file, those in chunks too.

    Attributes
    ----------
    complete : bool
        Whether the end of the data was reached.
    lost : Counter
        Messages by channel that stood in damaged chunks, by the indexes that follow those.
    """

    def __init__(self, file: Path, summary: Summary, on_damage: Damage) -> None:
        self.complete = False
        self.lost: Counter[int] = Counter()
        self._file = file
        self._on_damage = on_damage
        self._starts = sorted(index.chunk_start_offset for index in summary.chunk_indexes)
        self._has_chunks = bool(self._starts)
        self._told = False

    def tell(self, text: str) -> None:
        """Say a damage of this file."""
        self._told = True
        self._on_damage(f'{self._file}: {text}')

    def __iter__(self) -> Iterator[McapRecord]:
        with self._file.open('rb') as stream:
            start: int | None = 0
            while start is not None:
                stream.seek(start)
                start = yield from self._run(stream, start)

    def _run(self, stream: IO[bytes], start: int) -> Any:
        """Pieces from an offset on; returns where to go on after damage, None at the end."""
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
                    # A length that is too long, or a kind nobody knows, has swallowed a chunk.
                    self.tell(f'damaged after byte {read_to} of {size}')
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
                    # Recorders put all messages into chunks or none: it is taken for one only.
                    self.tell(f'damaged after byte {read_to} of {size}')
                    return self._start_after(read_to)
            self.tell(f'damaged before byte {read_to} of {size}: its data have no end')
        except _DAMAGE_ERRORS as error:
            following = self._start_after(read_to)
            if following is None and not self._told:
                at_end = isinstance(error, (EndOfFile, RecordLengthLimitExceeded))
                kind = 'cut off' if at_end or stream.tell() >= size else 'damaged'
                self.tell(
                    f'{kind} after byte {read_to} of {size} ({type(error).__name__});'
                    ' what stands before it was read'
                )
            elif following is not None:
                self.tell(f'damaged after byte {read_to} of {size} ({type(error).__name__})')
            return following
        return None

    def _start_after(self, offset: int) -> int | None:
        """Offset of the first chunk of the summary beyond an offset."""
        k = bisect.bisect_right(self._starts, offset)
        return self._starts[k] if k < len(self._starts) else None

    def _of_chunk(self, chunk: Chunk, end: int) -> Any:
        """Records of a chunk; returns whether its checksum and its compression were right."""
        try:
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        except Exception as error:
            self.tell(f'the chunk that ends at byte {end} is damaged and left out: {error}')
            return False
        yield from _inside(stream, length)
        return True


def _inside(stream: ReadDataStream, length: int) -> Iterator[McapRecord]:
    while stream.count < length:
        opcode, size = stream.read1(), stream.read8()
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, size)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(size)
