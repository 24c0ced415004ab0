"""
MCAP bags to records and back, without ROS.

Reading streams: one chunk of the file is in memory at a time.  Of a damaged bag, what is sound is
read; where it is damaged and what was lost is said once, to ``on_damage``.  Writing gives the same
bytes for the same records.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import functools
import io
import logging
import os
from pathlib import Path
import re
import sys
from types import TracebackType
from typing import Any, IO, NamedTuple, TYPE_CHECKING

from mcap.writer import CompressionType, Writer
import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore
import yaml

from starcal_ros.bag.mcap_reader import Damage, MAGIC, RawMessage, read_messages, read_summary
from starcal_ros.errors import BagError, ImageRefused
from starcal_ros.messages.calibration import calibration_to_message
from starcal_ros.messages.images import image_from_message, image_to_message, refused_from_message
from starcal_ros.messages.observations import observations_from_message, observations_to_message
from starcal_ros.messages.status import status_to_message
from starcal_ros.messages.telemetry import (
    attitude_from_message,
    attitude_to_message,
    temperature_from_message,
    temperature_to_message,
    velocity_from_message,
    velocity_to_message,
)
from starcal_ros.messages.types import (
    ATTITUDE_TYPE,
    CALIBRATION_TYPE,
    IMAGE_TYPE,
    Message,
    OBSERVATIONS_TYPE,
    STATUS_TYPE,
    TEMPERATURE_TYPE,
    VELOCITY_TYPE,
)
from starcal_ros.records import Calibration, EnsembleStatus, Image, refused_image, StarObservations
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory, AttitudeOptions

if TYPE_CHECKING:
    from typing_extensions import Self

Floats = NDArray[np.float64]

_SQLITE, _ROS_1 = b'SQLite format 3', b'#ROSBAG V'  # how bags of other kinds begin
_MAGIC_BYTES = 16
_CHUNK_BYTES = 4 << 20  # an image or two: what a crash can cost, and what a reader holds


@functools.lru_cache(maxsize=256)
def log_damage(text: str) -> None:
    """Say once that a bag is damaged, as a warning of the log ``starcal``."""
    logging.getLogger('starcal').warning('%s', text)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag with messages on it: ``type_name`` is ``'pkg/msg/Name'``."""

    name: str
    type_name: str
    count: int


def mcap_files(paths: Iterable[Path | str]) -> list[Path]:
    """
    The .mcap files of bags, in the order of recording.

    Raises
    ------
    BagError
        When a path is neither an .mcap file nor a folder with some.
    """
    files = []
    for path in map(Path, paths):
        if path.is_dir():
            files += _files_of_folder(path)
        elif path.exists():
            files.append(path)
        else:
            raise BagError(f'{path}: no such bag')
    for file in files:
        try:
            with file.open('rb') as stream:
                magic = stream.read(_MAGIC_BYTES)
        except OSError as error:
            raise BagError(f'{file}: cannot be read: {error.strerror}') from error
        if not magic.startswith(MAGIC):
            raise BagError(f'{file}: not an MCAP bag{_how_to_convert(file, magic)}')
    return files


def topics(paths: Iterable[Path | str], on_damage: Damage = log_damage) -> tuple[Topic, ...]:
    """
    Topics with messages, by name.

    From the summaries where the files have them; a cut off file is read through.
    """
    types: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for file in mcap_files(paths):
        for topic in _summary(file) or _counted(file, on_damage):
            types[topic.name] = topic.type_name
            counts[topic.name] += topic.count
    return tuple(Topic(name, types[name], counts[name]) for name in sorted(counts))


def _summary(file: Path) -> list[Topic]:
    """Topics by the summary of a file; none where it has no counts or is damaged."""
    summary = read_summary(file)
    if summary is None or summary.statistics is None:
        return []
    found = []
    for number, count in summary.statistics.channel_message_counts.items():
        channel = summary.channels[number]
        if count and channel.message_encoding == 'cdr':
            found.append(Topic(channel.topic, summary.schemas[channel.schema_id].name, count))
    return found


def _counted(file: Path, on_damage: Damage) -> list[Topic]:
    counts = Counter((raw.topic, raw.type_name) for raw in read_messages(file, None, on_damage))
    return [Topic(name, type_name, count) for (name, type_name), count in counts.items()]


def choose_topic(paths: Iterable[Path | str], type_name: str, asked: str = '') -> str:
    """
    The topic asked for, or the only one of a type.

    Raises
    ------
    BagError
        Listing the topics of the type there are.
    """
    paths = list(paths)
    where = ', '.join(map(str, paths))
    there = topics(paths)
    fitting = [topic.name for topic in there if topic.type_name == type_name]
    listed = ', '.join(fitting) or 'none'
    if asked:
        # Bags hold resolved names; a person may leave the slash out.
        for name in fitting:
            if name.lstrip('/') == asked.lstrip('/'):
                return name
        raise BagError(f'{where}: no topic {asked} of type {type_name} (there are: {listed})')
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        listed = ', '.join(topic.name for topic in there) or 'nothing'
        raise BagError(f'{where}: no topic of type {type_name} (there is {listed})')
    raise BagError(f'{where}: several topics of type {type_name}, name one: {listed}')


def read_raw(
    paths: Iterable[Path | str], only: Iterable[str] | None = None, on_damage: Damage = log_damage
) -> Iterator[RawMessage]:
    """Messages as they were recorded, in the order of the file; of some topics or of all."""
    wanted = None if only is None else frozenset(only)
    for file in mcap_files(paths):
        yield from read_messages(file, wanted, on_damage)


def read_images(
    paths: Iterable[Path | str],
    topic: str,
    stamp_offset_s: float = 0.0,
    on_damage: Damage = log_damage,
) -> Iterator[Image | StarObservations]:
    """Images of a topic one by one; one that cannot be decoded comes as refused observations."""
    for raw in read_raw(paths, [topic], on_damage):
        try:
            message = decode(raw)
        except BagError as error:
            yield refused_image(raw.log_time_ns, 0, 0, 'bad_layout', str(error))
            continue
        try:
            yield image_from_message(message, stamp_offset_s)
        except ImageRefused as refused:
            yield refused_from_message(message, stamp_offset_s, refused)


def read_attitudes(
    paths: Iterable[Path | str],
    topic: str,
    options: AttitudeOptions | None = None,
    on_damage: Damage = log_damage,
) -> AttitudeHistory:
    """All attitude samples of a topic; those that are no rotations are remembered as such."""
    options = options or AttitudeOptions()
    history = AttitudeHistory()
    for message in _decoded(paths, topic, on_damage):
        time_ns, quaternion = attitude_from_message(message)
        history.add(time_ns, attitude_sample(time_ns, quaternion, options.attitude_direction))
    return history


def read_velocities(
    paths: Iterable[Path | str], topic: str, on_damage: Damage = log_damage
) -> Iterator[tuple[int, Floats]]:
    """Stamps and velocities (3,) in m/s of a topic."""
    for message in _decoded(paths, topic, on_damage):
        yield velocity_from_message(message)


def read_temperatures(
    paths: Iterable[Path | str], topic: str, on_damage: Damage = log_damage
) -> Iterator[tuple[int, float]]:
    """Stamps and temperatures in degrees Celsius of a topic; NaN where not known."""
    for message in _decoded(paths, topic, on_damage):
        yield temperature_from_message(message)


def read_observations(
    paths: Iterable[Path | str], topic: str, on_damage: Damage = log_damage
) -> Iterator[StarObservations]:
    """
    Recorded observations of a topic.

    Raises
    ------
    BagError
        When a message is not observations as this version knows them.
    """
    for raw in read_raw(paths, [topic], on_damage):
        try:
            yield observations_from_message(decode(raw))
        except (AttributeError, ValueError) as error:
            raise BagError(f'{topic}: not readable as observations: {error}') from error


class _Channel(NamedTuple):
    number: int
    type_name: str
    latched: bool


class BagWriter:
    """
    Writes records to a bag: a folder, or the one file when the path ends in ``.mcap``.

    To be used in a ``with`` statement: only its end makes the bag complete, with the
    ``metadata.yaml`` that rosbag2 wants beside it.

    Parameters
    ----------
    path : Path or str
        Made where it does not exist; a bag of that name is replaced.
    compression : {'zstd', 'lz4', ''}
    """

    def __init__(self, path: Path | str, compression: str = 'zstd') -> None:
        path = Path(path)
        is_file = path.suffix == '.mcap'
        self.file = path if is_file else path / f'{path.name}_0.mcap'
        self._compression = CompressionType[(compression or 'none').upper()]
        self._channels: dict[str, _Channel] = {}
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._stream: IO[bytes] | None = None
        self._writer: Any = None

    def __enter__(self) -> Self:
        """Open the file."""
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.file.open('wb')
        except OSError as error:
            raise BagError(f'{self.file}: cannot be written: {error.strerror}') from error
        self._start(self._stream)
        return self

    def _start(self, stream: IO[bytes]) -> None:
        self._writer = Writer(stream, _CHUNK_BYTES, self._compression)
        self._writer.start('ros2', library='starcal')

    @classmethod
    def one_observation(cls, topic: str, record: StarObservations, frame_id: str) -> bytes:
        """The bytes of a whole bag that holds a single starcal/StarObservations."""
        stream = io.BytesIO()
        writer = cls('one.mcap')
        writer._start(stream)
        writer.write_observations(topic, record, frame_id)
        writer._writer.finish()
        return stream.getvalue()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Complete the file and write metadata.yaml."""
        assert self._stream is not None  # __enter__ has set it
        metadata = yaml.safe_dump(self._metadata(), sort_keys=True)
        try:
            self._writer.finish()
            self._stream.close()
            self.file.with_name('metadata.yaml').write_text(metadata)
        except OSError as failure:
            raise BagError(f'{self.file}: cannot be written: {failure.strerror}') from failure

    def write_image(self, topic: str, image: Image, frame_id: str) -> None:
        """Write a sensor_msgs/Image."""
        message = image_to_message(image, frame_id, make_message)
        self._write(topic, IMAGE_TYPE, image.time_ns, message)

    def write_attitude(self, topic: str, time_ns: int, xyzw: Floats, frame_id: str) -> None:
        """Write a geometry_msgs/QuaternionStamped in the inertial frame ``frame_id``."""
        message = attitude_to_message(time_ns, xyzw, frame_id, make_message)
        self._write(topic, ATTITUDE_TYPE, time_ns, message)

    def write_velocity(
        self, topic: str, time_ns: int, velocity_m_s: Floats, frame_id: str
    ) -> None:
        """Write a geometry_msgs/TwistStamped."""
        message = velocity_to_message(time_ns, velocity_m_s, frame_id, make_message)
        self._write(topic, VELOCITY_TYPE, time_ns, message)

    def write_temperature(
        self, topic: str, time_ns: int, temperature_degc: float, frame_id: str
    ) -> None:
        """Write a sensor_msgs/Temperature."""
        message = temperature_to_message(time_ns, temperature_degc, frame_id, make_message)
        self._write(topic, TEMPERATURE_TYPE, time_ns, message)

    def write_observations(self, topic: str, record: StarObservations, frame_id: str) -> None:
        """Write a starcal/StarObservations."""
        message = observations_to_message(record, frame_id, make_message)
        self._write(topic, OBSERVATIONS_TYPE, record.time_ns, message)

    def write_status(self, topic: str, status: EnsembleStatus, frame_id: str) -> None:
        """Write a starcal/EnsembleStatus."""
        message = status_to_message(status, frame_id, make_message)
        self._write(topic, STATUS_TYPE, status.time_ns, message)

    def write_calibration(self, topic: str, calibration: Calibration) -> None:
        """Write a starcal/Calibration."""
        message = calibration_to_message(calibration, make_message)
        self._write(topic, CALIBRATION_TYPE, calibration.time_ns, message, latched=True)

    def _write(
        self, topic: str, type_name: str, time_ns: int, message: object, latched: bool = False
    ) -> None:
        channel = self._channels.get(topic) or self._open(topic, type_name, latched)
        if channel.type_name != type_name:
            raise ValueError(f'topic: {topic} holds {channel.type_name}, not {type_name}')
        data = bytes(_typestore().serialize_cdr(message, type_name))
        try:
            self._writer.add_message(
                channel.number, time_ns, data, publish_time=time_ns, sequence=self._counts[topic]
            )
        except OSError as error:
            raise BagError(f'{self.file}: cannot be written: {error.strerror}') from error
        self._counts[topic] += 1
        self._first_ns = time_ns if self._first_ns is None else min(self._first_ns, time_ns)
        self._last_ns = max(self._last_ns, time_ns)

    def _open(self, topic: str, type_name: str, latched: bool) -> _Channel:
        definition, type_hash = _described(type_name)
        schema_id = self._writer.register_schema(type_name, 'ros2msg', definition.encode())
        metadata = {
            'offered_qos_profiles': yaml.safe_dump([_qos_profile(latched)], sort_keys=False),
            'topic_type_hash': type_hash,
        }
        number = self._writer.register_channel(topic, 'cdr', schema_id, metadata)
        self._channels[topic] = _Channel(number, type_name, latched)
        return self._channels[topic]

    def _metadata(self) -> dict[str, object]:
        """What rosbag2 keeps beside a bag, version 9."""
        first_ns = self._first_ns or 0

        def span() -> dict[
            str, object
        ]:  # afresh each time: YAML would write a reference to the first
            return {
                'starting_time': {'nanoseconds_since_epoch': first_ns},
                'duration': {'nanoseconds': max(self._last_ns - first_ns, 0)},
                'message_count': sum(self._counts.values()),
            }

        topic_list = [
            {
                'topic_metadata': {
                    'name': topic,
                    'type': channel.type_name,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [_qos_profile(channel.latched)],
                    'type_description_hash': _typestore().hash_rihs01(channel.type_name),
                },
                'message_count': self._counts[topic],
            }
            for topic, channel in self._channels.items()
        ]
        return {
            'rosbag2_bagfile_information': {
                'version': 9,
                'storage_identifier': 'mcap',
                'relative_file_paths': [self.file.name],
                **span(),
                'topics_with_message_count': topic_list,
                'compression_format': '',
                'compression_mode': '',
                'files': [{'path': self.file.name, **span()}],
                'custom_data': None,
                'ros_distro': 'jazzy',
            }
        }


def make_message(type_name: str, /, **fields: Any) -> Message:
    """Return a message of rosbags: the ``make`` of `messages` for bags."""
    return _typestore().types[type_name](**fields)


@functools.lru_cache(maxsize=1)
def _typestore() -> Typestore:
    """ROS's own types and starcal's."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = _definitions_folder()
    for type_name in (OBSERVATIONS_TYPE, STATUS_TYPE, CALIBRATION_TYPE):
        text = (folder / f'{type_name.rpartition("/")[2]}.msg').read_text()
        store.register(get_types_from_msg(text, type_name))
    return store


@functools.lru_cache(maxsize=64)
def _described(type_name: str) -> tuple[str, str]:
    """Definition of a type, with those that it is made of, and its hash."""
    definition, _ = _typestore().generate_msgdef(type_name, ros_version=2)
    return definition, _typestore().hash_rihs01(type_name)


def _definitions_folder() -> Path:
    """Where starcal's .msg files are: in the source tree, or in a ROS or Python prefix."""
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    candidates = [Path(__file__).parents[2] / 'msg']
    candidates += [Path(prefix) / 'share/starcal/msg' for prefix in prefixes if prefix]
    for folder in candidates:
        if (folder / 'StarObservations.msg').is_file():
            return folder
    raise BagError('the definitions of starcal/msg are not installed: ' + str(candidates[-1]))


def decode(raw: RawMessage) -> Message:
    """
    Decoded message: by ROS's and starcal's own definitions, else by that in the bag.

    Raises
    ------
    BagError
        When the bytes are not a message of the type.
    """
    store = _typestore()
    try:
        if raw.type_name not in store.types or raw.type_name.startswith('starcal/'):
            store = _typestore_with(raw.type_name, raw.definition)
        return store.deserialize_cdr(raw.data, raw.type_name)
    # Bytes that are not the message fail in whichever field comes first: no common base.
    except Exception as error:
        raise BagError(
            f'{raw.topic}: a {raw.type_name} of {len(raw.data)} bytes is not one'
        ) from error


def _decoded(paths: Iterable[Path | str], topic: str, on_damage: Damage) -> Iterator[Message]:
    """Messages of a topic; bytes that are none of its type are said and passed over."""
    for raw in read_raw(paths, [topic], on_damage):
        try:
            yield decode(raw)
        except BagError as error:
            on_damage(str(error))


@functools.lru_cache(maxsize=16)
def _typestore_with(type_name: str, definition: str) -> Typestore:
    """A store that knows a type as the bag defines it: another version may have written it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    found = get_types_from_msg(definition, type_name)
    store.register({name: fields for name, fields in found.items() if name not in store.types})
    return store


def _files_of_folder(folder: Path) -> list[Path]:
    """The .mcap files of a bag folder: those that its metadata.yaml lists, else all there are."""
    try:
        metadata = yaml.safe_load((folder / 'metadata.yaml').read_text())
        information = metadata['rosbag2_bagfile_information']
        names = [str(name) for name in information['relative_file_paths']]
        compression = str(information.get('compression_mode') or '')
    except (OSError, yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        names, compression = ([], '')  # lost or cut off with the recorder: the files speak
    if compression:
        raise BagError(
            f'{folder}: compressed by {compression.lower()}: ros2 bag convert can undo it'
        )
    listed = [folder / name for name in names if (folder / name).is_file()]
    found = listed or sorted(folder.glob('*.mcap'), key=_natural)
    if not found:
        other = _how_to_convert(folder, _SQLITE) if any(folder.glob('*.db3')) else ''
        inside = next(folder.glob('*/*.mcap'), None)
        near = f' (did you mean {inside.parent}?)' if inside and not other else ''
        raise BagError(f'{folder}: no .mcap files in the folder{other}{near}')
    missing = [name for name in names if not (folder / name).is_file()]
    if missing and listed:
        raise BagError(f'{folder}: metadata.yaml lists {missing[0]}, which is not there')
    return found


def _how_to_convert(path: Path, magic: bytes) -> str:
    """How to make an MCAP bag of a bag of another kind, as the end of a complaint."""
    if magic.startswith(_SQLITE):
        # rosbags converts the folder with its metadata.yaml, not the file in it.
        kind, source = 'an SQLite bag', path.parent if path.suffix == '.db3' else path
    elif magic.startswith(_ROS_1):
        kind, source = 'a ROS 1 bag', path
    else:
        return ''
    destination = source.with_name(f'{source.stem}_mcap')
    return (
        f' but {kind}: rosbags-convert --src {source} --dst {destination} --dst-storage mcap'
        ' makes one'
    )


def _natural(path: Path) -> list[tuple[int, str]]:
    # rosbag2 counts its files without leading zeros: bag_10 comes after bag_9.
    return [(int(part) if part.isdigit() else -1, part) for part in re.split(r'(\d+)', path.name)]


def _qos_profile(latched: bool) -> dict[str, object]:
    """Reliable, and kept for late readers if latched: an offer in the words of rosbag2."""

    def forever() -> dict[str, int]:
        return {'sec': 9223372036, 'nsec': 854775807}

    return {
        'history': 'keep_last',
        'depth': 1 if latched else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if latched else 'volatile',
        'deadline': forever(),
        'lifespan': forever(),
        'liveliness': 'automatic',
        'liveliness_lease_duration': forever(),
        'avoid_ros_namespace_conventions': False,
    }
