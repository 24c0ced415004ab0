# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Bags to records; a bag may be damaged.

MCAP is read without ROS.  Where the wheels for that are absent, rosbag2 of ROS reads MCAP and
SQLite (`rosbag2`), up to the damage.

Two chunks of the file are in memory at a time: one in use, one that another thread decompresses.
Messages may be in chunks and outside of them.
A chunk with a wrong checksum is skipped.  If the bytes between chunks are damaged, reading
continues at the next chunk listed in the summary; if the first chunk with the topic names is lost,
the names come from the summary.  A truncated file has no summary and is read up to its end.

The place of the damage and the lost messages are reported once, to ``on_damage``.  The lost are
counted from the summary or, without one, from the indexes after each chunk.
"""

from __future__ import annotations

import bisect
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
import contextlib
from dataclasses import dataclass, field, replace
import functools
import io
import itertools
import logging
import operator
import os
from pathlib import Path
import re
import shlex
import struct
from typing import Any, IO
import zlib

import numpy as np

from starcal_ground.bag_writer import ORIGIN
from starcal_ground.bags import rosbag2
from starcal_ground.file_kinds import NotABag
from starcal_ros.constants import MAX_STAMP_NS
from starcal_ros.errors import BagError, errors_as, ImageRefused
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.formats.messages.message_codec import Message, RawMessage
from starcal_ros.formats.messages.record_messages import checked_observations
from starcal_ros.formats.messages.sensor_messages import image_of, view_image
from starcal_ros.records import Image, ORIGINAL, PIXELS_OF, refused_image, StarObservations
from starcal_ros.text import printable
from starcal_ros.untrusted import ARCHIVE_BYTES, read_text, regular_file, yaml_value

if not rosbag2.READS_BAGS:
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
    from mcap.opcode import Opcode
    from mcap.reader import make_reader
    from mcap.records import (
        Channel,
        Chunk,
        DataEnd,
        Header,
        McapRecord,
        MessageIndex,
        Metadata,
        Schema,
    )
    from mcap.records import Message as McapMessage
    from mcap.stream_reader import get_chunk_data_stream, StreamReader
    from mcap.summary import Summary
    from rosbags.interfaces import Nodetype
    from rosbags.typesys.store import Typestore
    import zstandard

    from starcal_ros.formats.bag.typestore import store_with, typestore_of

    # Damaged bytes are parsed as an arbitrary record: the exceptions have no common base class.
    _DAMAGE_ERRORS = (McapError, ValueError, struct.error, KeyError, OverflowError, MemoryError)

Damage = Callable[[str], None]
Wanted = str | tuple[str, str]  # a topic, or its messages of one type

MAGIC = b'\x89MCAP0\r\n'
_MAGICS = (MAGIC, rosbag2.SQLITE_MAGIC) if rosbag2.READS_BAGS else (MAGIC,)
_SUFFIXES = ('.mcap', '.db3') if rosbag2.READS_BAGS else ('.mcap',)
IMAGE_FILE = 'image file '  # start of keys of `ORIGIN`: the stamp of an image follows, ns
OF_THE_STARS = '(stars)'
"""In place of a star tracker in recordings: the attitude is that of the image's own stars."""
METADATA_BYTES = 4 * 1024 * 1024  # 5000 topics
OF_ANOTHER_BAG = ' (of another bag)'  # behind the name of a file that two bags have
_FOOTER = struct.Struct('<BQQQI')  # kind, length, start of summary and of its offsets, checksum
_DATA_END = struct.Struct('<BQI')  # kind, length, checksum of all before it
_RECORD = struct.Struct('<BQ')  # kind, length
_MESSAGE = struct.Struct('<HIQQ')  # channel, sequence, times of log and publication
_ZSTD = b'\x28\xb5\x2f\xfd'  # RFC 8878, 3.1.1: CDR begins with a zero
_LATCHED = re.compile(r'durability: (1|transient_local)\b')  # a number in Humble, a word since
_LONGEST_NAME = 4096  # Linux has no longer path


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


def origin_of(paths: Iterable[Path | str]) -> dict[str, str]:
    """
    Entries of the provenance on the image files that bags were made of.

    Which of their pixels, and the SHA-256 of each; empty for a bag that does not state them, as a
    recorded one.  Raises BagError as `mcap_files`.
    """
    pixels_of: dict[str, None] = {}
    originals: dict[str, str] = {}
    for file in mcap_files(paths):
        for key, value in _stated_origin(file).items():
            name, text = printable(key), printable(value)
            if name == PIXELS_OF:
                pixels_of[text] = None
            elif name.startswith(ORIGINAL):
                while originals.setdefault(name, text) != text:
                    name += OF_ANOTHER_BAG
    origin = {PIXELS_OF: '; '.join(pixels_of)} if pixels_of else {}
    return origin | originals


def image_files(paths: Iterable[Path | str], offset_ns: int = 0) -> dict[int, str]:
    """
    Names of the files that the images of bags were made of, by stamp; empty for recorded bags.

    ``offset_ns`` is added to the stamps, as for those of the images.  Raises BagError as
    `mcap_files`.
    """
    return {
        int(stamp) + offset_ns: printable(value)
        for file in mcap_files(paths)
        for key, value in _stated_origin(file).items()
        if (stamp := key.removeprefix(IMAGE_FILE)) != key and stamp.isdecimal()
    }


def _stated_origin(file: Path) -> dict[str, str]:
    """Metadata `ORIGIN` of a file, which is before its messages; empty without one."""
    if rosbag2.READS_BAGS:
        return {}
    # Damage is reported where the messages are read.
    with regular_file(file) as stream, contextlib.suppress(*_DAMAGE_ERRORS):
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=METADATA_BYTES)
        for record in reader.records:
            if isinstance(record, Metadata) and record.name == ORIGIN:
                return record.metadata
            if not isinstance(record, (Header, Metadata)):
                break
    return {}


def _lacks_checksum(stream: IO[bytes]) -> bool:
    """True if the end of the data says so, as in recordings of rosbag2: only chunks have one."""
    try:
        end = stream.seek(-(_FOOTER.size + len(MAGIC)), os.SEEK_END)
        start = _FOOTER.unpack(stream.read(_FOOTER.size))[2] or end
        stream.seek(start - _DATA_END.size)
        return _DATA_END.unpack(stream.read(_DATA_END.size)) == (Opcode.DATA_END, 4, 0)
    except (OSError, ValueError, OverflowError, struct.error):
        return False


@dataclass(frozen=True)
class RecordedMessage(RawMessage):
    """
    A message of a bag; ``definition`` is that of its type there, empty for that of this version.

    ``place`` is its file, the offset of its chunk there, or its own, and its number in the chunk;
    None where the reader has none.
    """

    definition: str = ''
    place: tuple[Path, int, int] | None = field(default=None, compare=False)

    @property
    def data(self) -> bytes:
        """A copy of the message as bytes, because middleware does not accept a view."""
        return bytes(self.view)


def read_messages(
    file: Path, wanted: frozenset[Wanted] | None, on_damage: Damage
) -> Iterator[RecordedMessage]:
    """Intact messages that are wanted (None: all), in file order (rosbag2: in its own)."""
    if rosbag2.READS_BAGS:
        types = {topic.name: topic.type_name for topic in _listed_now(file)[0]}
        for topic, data, log_time_ns in rosbag2.read_messages(file, wanted, on_damage):
            if data[:4] == _ZSTD:
                what = 'its messages are compressed one by one, which rosbag2 leaves'
                raise BagError(f'{file}: {what}: {rosbag2.INSTALL}')
            yield RecordedMessage(topic, types[topic], log_time_ns, memoryview(data))
        return
    summary = read_summary(file)
    known = summary or Summary()
    schemas: dict[int, Schema] = dict(known.schemas)
    channels: dict[int, Channel] = dict(known.channels)
    texts: dict[int, str] = {}  # each definition once
    read: Counter[int] = Counter()
    pieces = _Pieces(file, known, on_damage)
    for record, place in pieces:
        if isinstance(record, Schema):
            schemas[record.id] = record
            texts.pop(record.id, None)
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, McapMessage):
            read[record.channel_id] += 1
            channel = channels.get(record.channel_id)
            schema = schemas.get(channel.schema_id) if channel else None
            if channel is None or schema is None or channel.message_encoding != 'cdr':
                continue  # its channel was in a damaged chunk, or it is not a ROS 2 message
            names = channel.topic, (channel.topic, schema.name)
            if wanted is None or not wanted.isdisjoint(names):
                if schema.id not in texts:
                    is_text = schema.encoding == 'ros2msg'  # else of an .idl file, or none
                    texts[schema.id] = schema.data.decode(errors='replace') if is_text else ''
                view, text = memoryview(_message(record.data)), texts[schema.id]
                yield RecordedMessage(
                    channel.topic, schema.name, record.log_time, view, text, (file, *place)
                )
    if summary is None and pieces.complete:
        pieces.report('truncated, or its summary is damaged; all messages before it were read')
    if known.statistics is not None:
        expected = Counter(known.statistics.channel_message_counts)
        lost = expected - read
    else:
        expected, lost = read + pieces.lost, pieces.lost
    nameless = {number: n for number, n in read.items() if number not in channels}
    if lost or nameless:
        pieces.report(_loss(lost, expected, channels, nameless))


def _message(data: bytes) -> bytes:
    """Bytes of a message, which rosbag2 may have compressed by itself; as they are if damaged."""
    if data[:4] == _ZSTD:
        with contextlib.suppress(zstandard.ZstdError, MemoryError):
            if zstandard.frame_content_size(data) <= ARCHIVE_BYTES:
                return zstandard.decompress(data)
    return data


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
    Schemas, channels and messages of a file, inside and outside chunks, each with its place.

    ``complete`` is True once the end of the data was reached; ``lost`` counts the messages in
    damaged chunks by channel, from the indexes after those chunks.
    """

    def __init__(self, file: Path, summary: Summary, on_damage: Damage) -> None:
        self.complete = False
        self.lost: Counter[int] = Counter()
        self._file = file
        self._on_damage = on_damage
        chunks = sorted((i.chunk_start_offset, i.chunk_length) for i in summary.chunk_indexes)
        self._starts = [start for start, _ in chunks]
        self._ends = [start + length for start, length in chunks]
        self._has_chunks = bool(self._starts)
        self._reported = False

    def report(self, text: str) -> None:
        """Report damage of this file."""
        self._reported = True
        self._on_damage(f'{self._file}: {text}')

    def __iter__(self) -> Iterator[tuple[McapRecord, tuple[int, int]]]:
        with regular_file(self._file) as stream:
            # A sum over the whole file would take a tenth of the time of reading it.
            has_checksum = not _lacks_checksum(stream)
            start: int | None = 0
            while start is not None:
                stream.seek(start)
                start = yield from self._run(stream, start, has_checksum)

    def _run(self, stream: IO[bytes], start: int, has_checksum: bool) -> Any:
        """Pieces after an offset; returns the offset to continue at after damage, or None."""
        size = os.fstat(stream.fileno()).st_size
        reader = StreamReader(
            stream,
            skip_magic=start > 0,
            emit_chunks=True,
            validate_crcs=has_checksum,
            record_size_limit=size,
        )
        read_to, chunk_is_sound = start, True
        try:
            for record, end, data in _decompressed(reader.records, stream):
                passed = self._start_after(read_to)
                if passed is not None and passed < end:
                    # A wrong length or an unknown opcode has skipped the start of a chunk.
                    self.report(f'damaged after byte {read_to} of {size}')
                    return passed
                place, read_to = read_to, end
                if data is not None:
                    self._has_chunks = True
                    chunk_is_sound = yield from self._of_chunk(data, place, read_to)
                elif isinstance(record, MessageIndex):
                    if not chunk_is_sound:
                        self.lost[record.channel_id] += len(record.records)
                elif isinstance(record, DataEnd):
                    self.complete = True
                    return None
                elif isinstance(record, (Schema, Channel)) or self._is_outside(place):
                    yield record, (place, 0)
                elif isinstance(record, McapMessage):
                    self.report(f'damaged after byte {read_to} of {size}')
                    return self._start_after(read_to)
            self.report(f'damaged before byte {read_to} of {size}: no end-of-data record')
        except _DAMAGE_ERRORS as error:
            following = self._start_after(read_to)
            if following is None and not self._reported:
                at_end = isinstance(error, (EndOfFile, RecordLengthLimitExceeded))
                kind = 'truncated' if at_end or stream.tell() >= size else 'damaged'
                self.report(
                    f'{kind} after byte {read_to} of {size}; all messages before it were read'
                )
            elif following is not None:
                self.report(f'damaged after byte {read_to} of {size}')
            return following
        return None

    def _start_after(self, offset: int) -> int | None:
        """Offset of the first chunk in the summary after an offset."""
        k = bisect.bisect_right(self._starts, offset)
        return self._starts[k] if k < len(self._starts) else None

    def _is_outside(self, offset: int) -> bool:
        """
        True if a record is outside all chunks; else it is the content of a damaged one.

        The summary has their places; without it, bytes after damage may be anything.
        """
        if not self._starts:
            return not (self._has_chunks and self._reported)
        k = bisect.bisect_right(self._starts, offset) - 1
        return k < 0 or offset >= self._ends[k]

    def _of_chunk(self, data: Future[bytes], start: int, end: int) -> Any:
        """Records of a chunk; returns False if its checksum or compression is invalid."""
        try:
            content = data.result()
        except Exception as error:
            self.report(f'skipped the damaged chunk that ends at byte {end}: {error}')
            return False
        yield from ((record, (start, k)) for k, record in enumerate(_inside(content)))
        return True


def _decompressed(
    records: Iterator[McapRecord], stream: IO[bytes]
) -> Iterator[tuple[McapRecord, int, Future[bytes] | None]]:
    """
    Yield records, the offset after each, and the data of a chunk.

    Another thread decompresses a chunk while the records of that before it are in use, where only
    indexes are between them.  Damage is raised after the records before it.
    """
    waiting: deque[tuple[McapRecord, int, Future[bytes] | None]] = deque()
    chunks, record, damage = 0, None, None
    with ThreadPoolExecutor(1, 'decompress') as thread:
        while not isinstance(record, DataEnd):
            try:
                record = next(records)
            except (StopIteration, *_DAMAGE_ERRORS) as error:
                damage = error
                break
            data = thread.submit(_data_of, record) if isinstance(record, Chunk) else None
            waiting.append((record, stream.tell(), data))
            chunks += data is not None
            ahead = chunks and isinstance(record, (Chunk, MessageIndex))
            while chunks > 1 or (waiting and not ahead):
                chunks -= waiting[0][2] is not None
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()
    if damage is not None and not isinstance(damage, StopIteration):
        raise damage


def _data_of(chunk: Chunk) -> bytes:
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(length)


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
            yield McapMessage(channel, log_time, content, publish_time, sequence)  # type: ignore[arg-type]
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(io.BytesIO(view[start:end])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(io.BytesIO(view[start:end])))
        start = end


@functools.lru_cache(maxsize=256)
def log_damage(text: str) -> None:
    """Log damage of a bag as a warning of the logger ``starcal``, each text once."""
    logging.getLogger('starcal').warning('%s', printable(text))


@dataclass(frozen=True)
class Topic:
    """
    Messages of one type, ``'pkg/msg/Name'``, on a topic of a bag, and their number.

    ``is_latched`` where the summary says that its publishers were transient local.
    """

    name: str
    type_name: str
    count: int
    is_latched: bool = False


@dataclass(frozen=True)
class Topics:
    """
    Topic of each kind of message that is read; empty: not requested, or not in the bag.

    ``more_attitudes`` are those of the further star trackers, in the order of the setup; empty
    where the bag has none of one.
    """

    image: str = ''
    attitude: str = ''
    velocity: str = ''
    temperature: str = ''
    observations: str = ''
    more_attitudes: tuple[str, ...] = ()

    @property
    def telemetry(self) -> frozenset[tuple[str, str]]:
        """Topics of attitudes, velocity and temperature, each with a type that is read there."""
        attitudes = itertools.product((self.attitude, *self.more_attitudes), codec.ATTITUDE_TYPES)
        single = (self.velocity, codec.VELOCITY_TYPE), (self.temperature, codec.TEMPERATURE_TYPE)
        return frozenset(pair for pair in (*attitudes, *single) if pair[0])

    @property
    def read(self) -> frozenset[tuple[str, str]]:
        """Topics of images and telemetry, or of observations, each with a type that is read."""
        images = {(self.image, kind) for kind in codec.IMAGE_TYPES} if self.image else set()
        recorded = {(self.observations, codec.OBSERVATIONS_TYPE)} if self.observations else set()
        return self.telemetry | images | recorded


def mcap_files(paths: Iterable[Path | str]) -> list[Path]:
    """
    MCAP files of bags in the order of their first messages, each once.

    An .mcap file that does not begin as one, as a crash leaves the last of a split bag, is damaged
    if there are others.  Raises BagError where a path has none.
    """
    files, others = [], []
    for path in map(Path, paths):
        if path.is_dir():
            files += _files_of_folder(path)
        elif os.path.lexists(path):
            files.append(path)
        else:
            raise BagError(f'{path}: no such file or folder')
    for file in files:
        # Opening a pipe would wait for its writer.
        with errors_as(BagError, file), regular_file(file) as stream:
            is_bag = stream.read(max(map(len, _MAGICS))).startswith(_MAGICS)
        if not is_bag:
            others.append(file)
    for file in others:
        if len(others) == len(files) or file.suffix != '.mcap':
            raise NotABag(f'{file}: not an MCAP bag', file)
    # A shell sorts rec_10 before rec_2.
    return sorted(dict.fromkeys(files), key=_first_ns)


def _first_ns(file: Path) -> int:
    """Time of recording of the first message of a file; 0 for an empty one."""
    return _listed_now(file)[2]


def files_of_bags(paths: Iterable[Path | str]) -> tuple[Path, ...]:
    """Files that bags are read from, metadata.yaml included; raises BagError as `mcap_files`."""
    bags = [Path(path) for path in paths]
    return (*mcap_files(bags), *(bag / 'metadata.yaml' for bag in bags if bag.is_dir()))


def topics(paths: Iterable[Path | str], on_damage: Damage = log_damage) -> tuple[Topic, ...]:
    """Topics with messages, by name and type; a file without a summary is read completely."""
    last: dict[tuple[str, str], Topic] = {}
    counts: Counter[tuple[str, str]] = Counter()
    for file in mcap_files(paths):
        listed, damage, _ = _listed_now(file)
        for text in damage:
            on_damage(text)
        for topic in listed:
            last[topic.name, topic.type_name] = topic
            counts[topic.name, topic.type_name] += topic.count
    return tuple(replace(last[key], count=counts[key]) for key in sorted(counts))


def _listed_now(file: Path) -> tuple[list[Topic], list[str], int]:
    status = file.stat()
    return _listed(file, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=256)
def _listed(file: Path, size: int, modified_ns: int) -> tuple[list[Topic], list[str], int]:
    """Topics of a file, its damage, and the time of its first message."""
    if rosbag2.READS_BAGS:
        there, first_ns = rosbag2.topics(file)
        return [Topic(*topic) for topic in there], [], first_ns
    summary = read_summary(file)
    damage: list[str] = []
    if summary is not None and summary.statistics is not None and (listed := _summary(summary)):
        return listed, damage, summary.statistics.message_start_time
    # Kept, as a file without summary is read for them.
    counts: Counter[tuple[str, str]] = Counter()
    first_ns = 0
    for raw in read_messages(file, None, damage.append):
        first_ns = raw.log_time_ns if not counts else min(first_ns, raw.log_time_ns)
        counts[raw.topic, raw.type_name] += 1
    return [Topic(*topic, count) for topic, count in counts.items()], damage, first_ns


def _summary(summary: Summary) -> list[Topic]:
    """Topics in the summary of a file; none if it has no counts."""
    listed = []
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    for number, count in counts.items():
        channel = summary.channels.get(number)
        schema = summary.schemas.get(channel.schema_id) if channel else None
        # Without a schema a message has no type: it is not of ROS 2.
        if count and channel and schema and channel.message_encoding == 'cdr':
            qos = channel.metadata.get('offered_qos_profiles', '')
            listed.append(Topic(channel.topic, schema.name, count, bool(_LATCHED.search(qos))))
    return listed


def choose_topic(paths: Iterable[Path | str], type_name: str, requested: str = '') -> str:
    """The requested topic, or the only one of a type; raises BagError with those there are."""
    paths = list(paths)
    where = ', '.join(map(str, paths))
    there = topics(paths)
    fitting = [topic.name for topic in there if topic.type_name == type_name]
    listed = ', '.join(fitting) or 'none'
    if requested:
        # Bags hold resolved names; the leading slash may be omitted in the request.
        for name in fitting:
            if name.lstrip('/') == requested.lstrip('/'):
                return name
        raise BagError(f'{where}: no topic {requested} of type {type_name} (available: {listed})')
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        listed = ', '.join(topic.name for topic in there) or 'none in cdr, the encoding of ROS 2'
        if not there and any(map(_is_of_ros_1, mcap_files(paths))):
            raise BagError(
                f'{where}: an MCAP of ROS 1 messages: convert the bag that it was made from by'
                ' rosbags-convert --src bag.bag --dst bag'
            )
        if lost := damage_of(paths):
            raise BagError(f'{lost}; no {type_name} is left: give the whole file')
        raise BagError(f'{where}: no topic of type {type_name} (topics: {listed})')
    raise BagError(f'{where}: several topics of type {type_name}: {listed}')


def damage_of(paths: Iterable[Path | str]) -> str:
    """Return the damage that reading the topics of bags reports; empty if there is none."""
    damage: list[str] = []
    topics(paths, damage.append)
    return '; '.join(damage)


def _is_of_ros_1(file: Path) -> bool:
    """True if the profile of a file, or a channel, is of ROS 1."""
    if rosbag2.READS_BAGS:
        return False
    with regular_file(file) as stream:
        start = stream.read(len(MAGIC) + _RECORD.size + 8)
    encodings = {c.message_encoding for c in (read_summary(file) or Summary()).channels.values()}
    return start.endswith(b'\x04\0\0\0ros1') or 'ros1' in encodings


def read_raw(
    paths: Iterable[Path | str],
    only: Iterable[Wanted] | None = None,
    on_damage: Damage = log_damage,
) -> Iterator[RecordedMessage]:
    """Serialised messages of the given topics, or of types on them (None: all), in file order."""
    wanted = None if only is None else frozenset(only)
    for file in mcap_files(paths):
        yield from read_messages(file, wanted, on_damage)


def by_stamp(
    paths: Iterable[Path | str], images: Iterable[Wanted], start: int = 0
) -> Iterator[RecordedMessage]:
    """
    Serialised images in the order of their stamps, without the first ones in file order.

    Their stamps are read first, then the images one by one, each with its chunk; two chunks are in
    memory.  Damage is not reported again.
    """
    kinds: dict[tuple[str, str, str], tuple[str, str, str]] = {}  # each definition once
    places = []
    for raw in itertools.islice(read_raw(paths, images, lambda _: None), start, None):
        kind = (raw.topic, raw.type_name, raw.definition)
        kind = kinds.setdefault(kind, kind)
        places.append((image_stamp_ns(raw), raw.place, raw.log_time_ns, kind))
    chunks: dict[tuple[Path, int], list[McapRecord]] = {}
    for _, place, log_time_ns, kind in sorted(places, key=operator.itemgetter(0)):
        assert place is not None  # the reader of MCAP files sets it
        file, offset, number = place
        chunk = chunks.pop((file, offset), None) or _records_at(file, offset)
        chunks = dict([*chunks.items(), ((file, offset), chunk)][-2:])
        record = chunk[number]
        assert isinstance(record, McapMessage)  # as when its place was found
        topic, type_name, definition = kind
        view = memoryview(_message(record.data))
        yield RecordedMessage(topic, type_name, log_time_ns, view, definition, place)


def image_stamp_ns(raw: RawMessage) -> int:
    """Stamp of a serialised image; the time of its recording if it cannot be decoded."""
    try:
        return codec.stamp_ns(view_image(raw).header.stamp)
    except ImageRefused:
        return min(max(raw.log_time_ns, 0), MAX_STAMP_NS)


def _records_at(file: Path, offset: int) -> list[McapRecord]:
    """Records of the chunk at an offset, or the record there; raises BagError after a change."""
    try:
        with regular_file(file) as stream:
            stream.seek(offset)
            limit = os.fstat(stream.fileno()).st_size
            reader = StreamReader(stream, True, emit_chunks=True, record_size_limit=limit)
            record = next(reader.records)
            return list(_inside(_data_of(record))) if isinstance(record, Chunk) else [record]
    except (OSError, StopIteration, *_DAMAGE_ERRORS) as error:
        raise BagError(f'{file}: changed while it was read: try again') from error


def read_images(
    paths: Iterable[Path | str],
    topic: str,
    stamp_offset_s: float = 0.0,
    on_damage: Damage = log_damage,
    channel: str = '',
) -> Iterator[Image | StarObservations]:
    """Images of a topic in file order, as `image_of` reads them."""
    for raw in read_raw(paths, Topics(topic).read, on_damage):
        yield image_of(raw, stamp_offset_s, channel=channel)


def read_observations(
    paths: Iterable[Path | str], topic: str, on_damage: Damage = log_damage
) -> Iterator[StarObservations]:
    """
    Recorded observations of a topic.

    Those with impossible values, or that cannot be decoded, become refused ones.

    Examples
    --------
    >>> import starcal_ground
    >>> observed = starcal_ground.read_observations(['out/observations.mcap'], '/observations')
    >>> len(next(observed).measured_px) > 10
    True
    """
    for raw in read_raw(paths, Topics(observations=topic).read, on_damage):
        try:
            yield checked_observations(decode(raw))
        except BagError as error:
            yield refused_image(raw.log_time_ns, 0, 0, 'bad_observations', str(error))


def decode(raw: RecordedMessage) -> Message:
    """Message by the definition in the bag, else by that of ROS 2; raises BagError."""
    try:
        if rosbag2.READS_BAGS:
            return rosbag2.decode(raw.view, raw.type_name)
        store = typestore_of(raw.type_name, raw.definition)
        return store.deserialize_cdr(raw.view, raw.type_name)
    # The exceptions of wrong bytes depend on the field and have no common base class.
    except Exception as error:
        raise _undecodable(raw, error) from error


def cdr_of_this_version(raw: RecordedMessage) -> bytes:
    """
    Bytes of a message for ROS, whose definition is that of this version; raises BagError.

    The fields that a message of another version lacks are zeros, as of a sender that does not
    have them.
    """
    if rosbag2.READS_BAGS:
        return raw.data
    try:
        store, own = typestore_of(raw.type_name, raw.definition), store_with(raw.type_name)
        if store is own:
            return raw.data
        message = store.deserialize_cdr(raw.view, raw.type_name)
        whole = _filled(own, (Nodetype.NAME, raw.type_name), message)
        return bytes(own.serialize_cdr(whole, raw.type_name))
    except Exception as error:
        raise _undecodable(raw, error) from error


def _filled(store: Typestore, kind: Any, value: Any = None) -> Any:
    """Return a value as one of a field of a store; what it lacks, or all for None, is zero."""
    node, content = kind
    if node == Nodetype.NAME:
        fields = store.fielddefs[content][1]
        return store.types[content](
            *(_filled(store, of_field, getattr(value, name, None)) for name, of_field in fields)
        )
    if node == Nodetype.BASE:
        return ('' if content[0] == 'string' else 0) if value is None else value
    item, size = content
    is_number = item[0] == Nodetype.BASE and item[1][0] != 'string'
    if value is None:
        length = size if node == Nodetype.ARRAY else 0
        value = np.zeros(length, item[1][0]) if is_number else [None] * length
    return value if is_number else [_filled(store, item, one) for one in value]


def _undecodable(raw: RawMessage, error: Exception) -> BagError:
    """Error of a message whose definition or bytes are wrong, with its topic."""
    if isinstance(error, BagError):
        return BagError(f'{raw.topic}: {raw.type_name} is {error}')
    return BagError(f'{raw.topic}: cannot decode {len(raw.view)} bytes as {raw.type_name}')


def _files_of_folder(folder: Path) -> list[Path]:
    """MCAP files of a bag folder: those listed in metadata.yaml, else all in the folder."""
    names, compression = _metadata(folder / 'metadata.yaml')
    if compression:  # zstd leaves the files without the ending
        names = [name.removesuffix('.zstd') for name in names]
    here = sorted(folder.iterdir(), key=_natural)
    listed = [folder / name for name in names if (folder / name).is_file()]
    there = [path for path in here if path.suffix in _SUFFIXES and path.is_file()]
    files = listed or there
    for path in (path for path in there if path not in files):
        log_damage(f'{path}: not read, as metadata.yaml does not list it')
    missing = [name for name in names if not (folder / name).is_file()]
    packed = bool(missing) and (folder / f'{missing[0]}.zstd').is_file()
    if missing and (listed or packed):
        remedy = f': zstd -d {shlex.quote(str(folder))}/*.zstd' if packed else ''
        raise BagError(f'{folder}: {missing[0]} is listed in metadata.yaml but missing{remedy}')
    if not files:
        inside = next(folder.glob('*/*.mcap'), None)
        near = f' (did you mean {inside.parent}?)' if inside else ''
        raise NotABag(f'{folder}: no .mcap files in the folder{near}', folder)
    return files


def _metadata(path: Path) -> tuple[list[str], str]:
    """Names of the files of a bag and its compression, both empty without valid metadata."""
    try:
        return _listed_files(read_text(path, METADATA_BYTES))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return [], ''  # a recorder that was killed leaves no valid metadata


@functools.lru_cache(maxsize=16)
def _listed_files(metadata: str) -> tuple[list[str], str]:
    """Return the same of a text, which a command asks for ten times."""
    information = yaml_value(metadata)['rosbag2_bagfile_information']
    names, compression = information['relative_file_paths'], information.get('compression_mode')
    if not isinstance(names, list) or not all(map(_is_inside, names)):
        names = []
    known = isinstance(compression, str) and re.fullmatch(r'\w{1,20}', compression)
    return names, compression if known and compression.lower() != 'none' else ''


def _is_inside(name: object) -> bool:
    """True if a value of metadata.yaml names a file below the folder of its bag."""
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        return False
    return not Path(name).is_absolute() and '..' not in Path(name).parts


def _natural(path: Path) -> list[tuple[int, str]]:
    # rosbag2 numbers files without leading zeros: bag_10 follows bag_9.
    return [(int(part) if part.isdigit() else -1, part) for part in re.split(r'(\d+)', path.name)]
