# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
MCAP bags to records, without ROS.

One chunk of the file is in memory at a time.  Intact chunks of a damaged bag are still read; the
place of the damage and the lost messages are reported once, to ``on_damage``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
import contextlib
from dataclasses import dataclass
import functools
import logging
import os
from pathlib import Path
import re
import shlex

from mcap.summary import Summary

from starcal_ros.errors import BagError, errors_as, ImageRefused
from starcal_ros.formats.bag.mcap_reader import Damage, RawMessage, read_messages, read_summary
from starcal_ros.formats.bag.typestore import typestore, typestore_of
from starcal_ros.formats.file_kinds import FileKind, kind_of, MCAP, ROS_1_BAG, SQLITE_BAG
from starcal_ros.formats.messages.image_messages import image_from_message, refused_from_message
from starcal_ros.formats.messages.message_fields import (
    ATTITUDE_TYPES,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    Message,
    nearest_stamp_ns,
    TEMPERATURE_TYPE,
    VELOCITY_TYPE,
)
from starcal_ros.formats.messages.observation_messages import checked_observations
from starcal_ros.records import Image, refused_image, StarObservations
from starcal_ros.text import printable
from starcal_ros.untrusted import METADATA_BYTES, read_text, yaml_value

_OF_IMAGES = (
    ': starcal calibrate or init takes images alone; starcal import makes a bag of image files and'
    ' attitudes'
)
# Topics of other types may be unknown to the converter, which then stops.
_CONVERTED = frozenset(
    [IMAGE_TYPE, COMPRESSED_TYPE, *ATTITUDE_TYPES, VELOCITY_TYPE, TEMPERATURE_TYPE]
)
_LONGEST_NAME = 4096  # of a path on Linux


@functools.lru_cache(maxsize=256)
def log_damage(text: str) -> None:
    """Log damage of a bag as a warning of the logger ``starcal``, each text once."""
    logging.getLogger('starcal').warning('%s', printable(text))


@dataclass(frozen=True)
class Topic:
    """Topic of a bag with its message count; ``type_name`` is ``'pkg/msg/Name'``."""

    name: str
    type_name: str
    count: int


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
    def telemetry(self) -> tuple[str, ...]:
        """Topics of attitudes, velocity and temperature."""
        single = (self.attitude, self.velocity, self.temperature)
        return tuple(filter(None, (*single, *self.more_attitudes)))


def mcap_files(paths: Iterable[Path | str]) -> list[Path]:
    """
    MCAP files of bags in the order of their first messages, each once.

    Raises BagError where a path has none.
    """
    files = []
    for path in map(Path, paths):
        if path.is_dir():
            files += _files_of_folder(path)
        elif os.path.lexists(path):
            files.append(path)
        else:
            raise BagError(f'{path}: no such bag')
    for file in files:
        with errors_as(BagError, file):  # opening a pipe would wait for its writer
            kind = kind_of(file)
        if kind is not MCAP:
            raise BagError(f'{file}: not an MCAP bag{_instead(file, kind)}')
    # A shell sorts rec_10 before rec_2.
    return sorted(dict.fromkeys(files), key=_first_ns)


def _first_ns(file: Path) -> int:
    """Time of recording of the first message of a file; 0 for an empty one."""
    status = file.stat()
    return _listed(file, status.st_size, status.st_mtime_ns)[2]


def files_of_bags(paths: Iterable[Path | str]) -> tuple[Path, ...]:
    """Files that bags are read from, metadata.yaml included; raises BagError as `mcap_files`."""
    bags = [Path(path) for path in paths]
    return (*mcap_files(bags), *(bag / 'metadata.yaml' for bag in bags if bag.is_dir()))


def topics(paths: Iterable[Path | str], on_damage: Damage = log_damage) -> tuple[Topic, ...]:
    """Topics with messages, by name; a file without a summary is read completely."""
    types: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for file in mcap_files(paths):
        status = file.stat()
        listed, damage, _ = _listed(file, status.st_size, status.st_mtime_ns)
        for text in damage:
            on_damage(text)
        for topic in listed:
            types[topic.name] = topic.type_name
            counts[topic.name] += topic.count
    return tuple(Topic(name, types[name], counts[name]) for name in sorted(counts))


@functools.lru_cache(maxsize=256)
def _listed(file: Path, size: int, modified_ns: int) -> tuple[list[Topic], list[str], int]:
    """Topics of a file, its damage, and the time of its first message."""
    summary = read_summary(file)
    damage: list[str] = []
    if summary is not None and summary.statistics is not None and (found := _summary(summary)):
        return found, damage, summary.statistics.message_start_time
    # Kept, as a file without summary is read for them.
    counts: Counter[tuple[str, str]] = Counter()
    first_ns = 0
    for raw in read_messages(file, None, damage.append):
        first_ns = raw.log_time_ns if not counts else min(first_ns, raw.log_time_ns)
        counts[raw.topic, raw.type_name] += 1
    return [Topic(*topic, count) for topic, count in counts.items()], damage, first_ns


def _summary(summary: Summary) -> list[Topic]:
    """Topics in the summary of a file; none if it has no counts."""
    found = []
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    for number, count in counts.items():
        channel = summary.channels.get(number)
        schema = summary.schemas.get(channel.schema_id) if channel else None
        # Without a schema a message has no type: it is not of ROS 2.
        if count and channel and schema and channel.message_encoding == 'cdr':
            found.append(Topic(channel.topic, schema.name, count))
    return found


def choose_topic(paths: Iterable[Path | str], type_name: str, asked: str = '') -> str:
    """The requested topic, or the only one of a type; raises BagError with those there are."""
    paths = list(paths)
    where = ', '.join(map(str, paths))
    there = topics(paths)
    fitting = [topic.name for topic in there if topic.type_name == type_name]
    listed = ', '.join(fitting) or 'none'
    if asked:
        # Bags hold resolved names; the leading slash may be omitted in the request.
        for name in fitting:
            if name.lstrip('/') == asked.lstrip('/'):
                return name
        raise BagError(f'{where}: no topic {asked} of type {type_name} (available: {listed})')
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        listed = ', '.join(topic.name for topic in there) or 'none'
        raise BagError(f'{where}: no topic of type {type_name} (topics: {listed})')
    raise BagError(f'{where}: several topics of type {type_name}, choose one: {listed}')


def read_raw(
    paths: Iterable[Path | str], only: Iterable[str] | None = None, on_damage: Damage = log_damage
) -> Iterator[RawMessage]:
    """Serialised messages of the given topics (None: all), in file order."""
    wanted = None if only is None else frozenset(only)
    for file in mcap_files(paths):
        yield from read_messages(file, wanted, on_damage)


def read_images(
    paths: Iterable[Path | str],
    topic: str,
    stamp_offset_s: float = 0.0,
    on_damage: Damage = log_damage,
    channel: str = '',
) -> Iterator[Image | StarObservations]:
    """Images of a topic, as `image_of` reads them."""
    for raw in read_raw(paths, [topic], on_damage):
        yield image_of(raw, stamp_offset_s, channel=channel)


def image_of(
    raw: RawMessage,
    stamp_offset_s: float = 0.0,
    size: tuple[int, int] | None = None,
    channel: str = '',
) -> Image | StarObservations:
    """
    Image of a message; refused observations if it cannot be decoded.

    So is a compressed image of another ``size`` (width, height), where one is given.
    ``channel`` is the colour that is taken of colour images (`image_from_message`).
    """
    try:
        message = decode(raw)
    except BagError as error:
        return refused_image(nearest_stamp_ns(raw.log_time_ns), 0, 0, 'bad_layout', str(error))
    try:
        return image_from_message(message, stamp_offset_s, size, channel)
    except ImageRefused as refused:
        return refused_from_message(message, stamp_offset_s, refused)


def read_observations(
    paths: Iterable[Path | str], topic: str, on_damage: Damage = log_damage
) -> Iterator[StarObservations]:
    """
    Recorded observations of a topic; an image with impossible values becomes a refused one.

    Raises BagError if this version cannot convert a message to observations.
    """
    for raw in read_raw(paths, [topic], on_damage):
        try:
            yield checked_observations(decode(raw))
        except (AttributeError, ValueError) as error:
            raise BagError(f'{topic}: not readable as observations: {error}') from error


def decode(raw: RawMessage) -> Message:
    """Message by the definition in the bag, else by that of ROS 2; raises BagError."""
    try:
        store = typestore_of(raw.type_name, raw.definition)
        return store.deserialize_cdr(raw.view, raw.type_name)
    # The exceptions of wrong bytes depend on the field and have no common base class.
    except Exception as error:
        raise BagError(
            f'{raw.topic}: cannot decode {len(raw.view)} bytes as {raw.type_name}'
        ) from error


def _files_of_folder(folder: Path) -> list[Path]:
    """MCAP files of a bag folder: those listed in metadata.yaml, else all in the folder."""
    names, compression = _metadata(folder / 'metadata.yaml')
    if compression.lower() == 'message':
        raise BagError(
            f'{folder}: its messages are compressed one by one: ros2 bag convert -i'
            f' {shlex.quote(str(folder))} -o out.yaml, with a file out.yaml of the line'
            f' "output_bags: [{{uri: {folder.name}_mcap, storage_id: mcap, all_topics: true}}]"'
        )
    if compression:  # of files, which zstd leaves without the ending
        names = [name.removesuffix('.zstd') for name in names]
    here = sorted(folder.iterdir(), key=_natural)
    listed = [folder / name for name in names if (folder / name).is_file()]
    found = listed or [path for path in here if path.suffix == '.mcap' and path.is_file()]
    if not found:
        inside = next(folder.glob('*/*.mcap'), None)
        near = f' (did you mean {inside.parent}?)' if inside else ''
        raise BagError(f'{folder}: no .mcap files in the folder{_instead_of_any(here) or near}')
    missing = [name for name in names if not (folder / name).is_file()]
    if missing and listed:
        packed = (folder / f'{missing[0]}.zstd').is_file()
        remedy = f': zstd -d {shlex.quote(str(folder))}/*.zstd' if packed else ''
        raise BagError(f'{folder}: {missing[0]} is listed in metadata.yaml but missing{remedy}')
    return found


def _instead_of_any(files: Iterable[Path]) -> str:
    """End of an error message on a folder without MCAP files: the first file that is of use."""
    for file in files:
        with contextlib.suppress(OSError, ValueError):
            kind = SQLITE_BAG if file.suffix == '.db3' else kind_of(file)
            if kind.is_image or kind.instead or kind in (SQLITE_BAG, ROS_1_BAG):
                return f', but {file.name}:{_instead(file, kind).removeprefix(" but")}'
    return ''


def _metadata(path: Path) -> tuple[list[str], str]:
    """Names of the files of a bag and its compression, both empty without valid metadata."""
    try:
        metadata = yaml_value(read_text(path, METADATA_BYTES))
        information = metadata['rosbag2_bagfile_information']
        names = information['relative_file_paths']
        compression = information.get('compression_mode')
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return [], ''  # a recorder that was killed leaves no valid metadata
    if not isinstance(names, list) or not all(map(_is_inside, names)):
        names = []
    known = isinstance(compression, str) and re.fullmatch(r'\w{1,20}', compression)
    return names, compression if known and compression.lower() != 'none' else ''


def _is_inside(name: object) -> bool:
    """True if a value of metadata.yaml names a file below the folder of its bag."""
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        return False
    return not Path(name).is_absolute() and '..' not in Path(name).parts


def _instead(file: Path, kind: FileKind) -> str:
    """End of an error message on a file that is no MCAP bag: what it is, and what helps."""
    if kind.is_image:
        return f' but {kind.name}{_OF_IMAGES}'
    if kind.instead:
        return f' but {kind.name}: {kind.instead.replace("FILE", shlex.quote(str(file)))}'
    if kind not in (SQLITE_BAG, ROS_1_BAG):
        return ''
    # rosbags converts the folder with its metadata.yaml, not the file in it.
    source = file.parent if kind is SQLITE_BAG else file
    command = ['rosbags-convert', '--src', str(source)]
    command += ['--dst', str(source.with_name(f'{source.stem}_mcap')), '--dst-storage', 'mcap']
    if names := _convertible(source):
        command += ['--include-topic', *names]
    return f' but {kind.name}: {shlex.join(command)} makes one'


def _convertible(source: Path) -> list[str]:
    """Topics that starcal reads of a bag of another kind; none where it cannot be opened."""
    from rosbags.highlevel import AnyReader  # seldom needed, slow to load

    # The exceptions of a damaged bag have no common base class.
    with contextlib.suppress(Exception), AnyReader([source], default_typestore=typestore()) as bag:
        return sorted(name for name, topic in bag.topics.items() if topic.msgtype in _CONVERTED)
    return []


def _natural(path: Path) -> list[tuple[int, str]]:
    # rosbag2 numbers files without leading zeros: bag_10 follows bag_9.
    return [(int(part) if part.isdigit() else -1, part) for part in re.split(r'(\d+)', path.name)]
