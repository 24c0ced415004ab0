# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags: round trips, independent readers and writers, damage."""

from collections.abc import Iterator
import io
from pathlib import Path
import re
import shutil
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk, DataEnd, Footer, McapRecord, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
import yaml
import zstandard

from starcal_ground.bag_writer import BagWriter, image_to_message
from starcal_ground.bags import reader as bag_reader
from starcal_ground.bags.frames import read_telemetry
from starcal_ground.bags.reader import Damage, Topics
from starcal_ros.errors import BagError
from starcal_ros.formats.bag import typestore as typestore_module
from starcal_ros.formats.bag.typestore import make_message, typestore
from starcal_ros.formats.messages.message_codec import ATTITUDE_TYPE, IMAGE_TYPE, stamp_ns
from starcal_ros.formats.messages.sensor_messages import image_to_message as picture_to_message
from starcal_ros.records import Image, refused_image, StarObservations
from starcal_ros.sky.attitude import AttitudeHistory

SHARED = Path(__file__).parents[4] / 'shared'  # inputs from elsewhere, not part of the tree
START_NS = 1_700_000_000_000_000_000
SECOND_NS = 10**9


def write_bag(path: Path, images: int = 6, size: int = 600) -> Path:
    """Write a bag of noise images, one a second, with two attitudes about each."""
    random = np.random.default_rng(1)
    with BagWriter(path) as writer:
        for k in range(images):
            time_ns = START_NS + k * SECOND_NS
            pixels = random.integers(0, 4096, (size, size + 2)).astype(np.uint16)
            half = np.array([0.0, np.sin(k / 9), 0.0, np.cos(k / 9)])
            writer.write_attitude('/attitude', time_ns - 100, half, 'icrf')
            writer.write_image('/image', Image(time_ns, pixels), 'camera')
            writer.write_attitude('/attitude', time_ns + 100, half, 'icrf')
            record = refused_image(time_ns, size + 2, size, 'no_stars', str(k))
            writer.write_observations('/observations', record, 'camera')
            writer.write_velocity('/velocity', time_ns, np.array([k, 2.0, 3e4]), 'icrf')
            writer.write_temperature('/temperature', time_ns, 20.0 - k, 'camera')
    return path


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp('bag') / 'six')


def images_of(path: Path, **options: Any) -> list[Image | StarObservations]:
    return list(bag_reader.read_images([path], '/image', **options))


def attitudes_of(path: Path, on_damage: Damage, topic: str = '/attitude') -> AttitudeHistory:
    return read_telemetry([path], Topics('', topic), on_damage=on_damage).attitudes


@pytest.mark.parametrize('compression', CompressionType)
@pytest.mark.parametrize('name', ['b', 'b.mcap'])
def test_round_trip(tmp_path, monkeypatch, compression, name) -> None:
    monkeypatch.setattr(typestore_module, '_COMPRESSION', compression)
    path = write_bag(tmp_path / name)
    assert (tmp_path / name).is_file() == name.endswith('.mcap')
    images = images_of(path)
    random = np.random.default_rng(1)
    assert len(images) == 6
    for k, image in enumerate(images):
        assert isinstance(image, Image)
        assert image.time_ns == START_NS + k * SECOND_NS
        np.testing.assert_array_equal(image.pixels, random.integers(0, 4096, (600, 602)))
    telemetry = read_telemetry([path], Topics('', '/attitude', '/velocity', '/temperature'))
    attitudes = telemetry.attitudes
    assert len(attitudes) == 12
    xyzw, gap_s = attitudes.at(START_NS + SECOND_NS, max_gap_s=1.0)
    np.testing.assert_allclose(xyzw, [0, np.sin(1 / 9), 0, np.cos(1 / 9)], atol=1e-15)
    assert gap_s == pytest.approx(2e-7)
    details = [record.detail for record in bag_reader.read_observations([path], '/observations')]
    assert details == list('012345')
    time_ns, velocity_m_s = telemetry.velocities[5]
    assert (time_ns, velocity_m_s.tolist()) == (START_NS + 5 * SECOND_NS, [5.0, 2.0, 3e4])
    assert telemetry.temperatures[5] == (START_NS + 5 * SECOND_NS, 15.0)


def test_read_by_rosbags(folder) -> None:
    with AnyReader([folder]) as reader:
        assert reader.message_count == 36
        image = next(c for c in reader.connections if c.topic == '/image')
        assert image.msgtype == 'sensor_msgs/msg/Image'
        decode: Any = reader.deserialize
        found = [
            (time_ns, stamp_ns(decode(data, c.msgtype).header.stamp))
            for c, time_ns, data in reader.messages([image])
        ]
        assert found == [(START_NS + k * SECOND_NS,) * 2 for k in range(6)]
        observations = next(c for c in reader.connections if c.topic == '/observations')
        data = next(iter(reader.messages([observations])))[2]
        assert decode(data, observations.msgtype).detail == '0'


def test_metadata_for_rosbag2(folder, tmp_path) -> None:
    """Profile, encodings, offered QoS, type hashes and metadata.yaml, the same in each run."""
    again = write_bag(tmp_path / 'six')
    for file in sorted(folder.iterdir()):
        assert file.read_bytes() == (again / file.name).read_bytes()
    with next(folder.glob('*.mcap')).open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
    assert summary is not None
    assert {c.message_encoding for c in summary.channels.values()} == {'cdr'}
    assert {s.encoding for s in summary.schemas.values()} == {'ros2msg'}
    for channel in summary.channels.values():
        (profile,) = yaml.safe_load(channel.metadata['offered_qos_profiles'])
        assert profile['reliability'] == 'reliable'
        assert channel.metadata['topic_type_hash'].startswith('RIHS01_')
    schema = next(s for s in summary.schemas.values() if s.name.endswith('StarObservations'))
    for part in (b'MSG: std_msgs/Header', b'MSG: geometry_msgs/Quaternion', b'catalog_digest'):
        assert part in schema.data
    text = (folder / 'metadata.yaml').read_text()
    assert '&' not in text, 'references are legal YAML that few write'
    information = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert information['version'] == 9
    assert information['message_count'] == 36
    assert information['starting_time'] == {'nanoseconds_since_epoch': START_NS - 100}
    assert information['duration'] == {'nanoseconds': 5 * SECOND_NS + 200}
    assert information['relative_file_paths'] == ['six_0.mcap']


@pytest.mark.parametrize(('content', 'kind'), [(b'', 'truncated'), (bytes(4096), 'damaged')])
def test_split_bag_is_read_in_order(tmp_path, content, kind) -> None:
    """Files of a split bag are read in recording order: 10 after 9; a crash lost the last."""
    (tmp_path / 'split').mkdir()
    for k in (0, 9, 10):
        with BagWriter(tmp_path / 'split' / f'split_{k}.mcap') as writer:
            writer.write_image('/image', Image(k, np.zeros((2, 2), np.uint8)), '')
    (tmp_path / 'split' / 'split_11.mcap').write_bytes(content)
    for paths in ([tmp_path / 'split'], sorted((tmp_path / 'split').iterdir())):
        told: list[str] = []
        images = bag_reader.read_raw(paths, ['/image'], told.append)
        assert [image.log_time_ns for image in images] == [0, 9, 10]
        (sentence,) = told
        assert f'split_11.mcap: {kind} after byte 0 of {len(content)}' in sentence


def test_a_file_that_the_metadata_do_not_list_is_named(tmp_path, folder, caplog) -> None:
    """Its images were missing without a word."""
    bag = Path(shutil.copytree(folder, tmp_path / 'bag'))
    shutil.copy(bag / 'six_0.mcap', bag / 'six_1.mcap')
    assert len(images_of(bag)) == 6
    assert caplog.messages == [
        f'{bag / "six_1.mcap"}: not read, as metadata.yaml does not list it'
    ]


def write_rubbish(writer: BagWriter, topic: str, time_ns: int) -> None:
    number, _ = writer._channels[topic]
    writer._writer.add_message(number, time_ns, b'\x00\x01\x00\x00rubbish', time_ns)


def test_bad_messages_do_not_end_the_run(tmp_path) -> None:
    """A colour image and undecodable messages become refusals between the others."""
    colour = picture_to_message(7, np.zeros((2, 3, 3), np.uint8), 'cam', make_message)
    record = refused_image(5, 3, 2, 'no_stars', 'sound')
    with BagWriter(tmp_path / 'mixed') as writer:
        writer.write_image('/image', Image(6, np.zeros((2, 3), np.uint8)), '')
        writer.write('/image', IMAGE_TYPE, 7, colour)
        write_rubbish(writer, '/image', 8)
        writer.write_image('/image', Image(9, np.zeros((2, 3), np.uint8)), '')
        writer.write_observations('/observations', record, 'camera')
        write_rubbish(writer, '/observations', 6)
        writer.write_observations('/observations', record, 'camera')
    first, second, third, last = images_of(tmp_path / 'mixed', stamp_offset_s=1e-9)
    assert isinstance(first, Image) and first.time_ns == 7
    assert isinstance(second, StarObservations)
    assert (second.refusal, second.time_ns, second.width) == ('bad_encoding', 8, 3)
    assert isinstance(third, StarObservations) and third.refusal == 'bad_layout'
    assert isinstance(last, Image)
    before, bad, after = bag_reader.read_observations([tmp_path / 'mixed'], '/observations')
    assert before.detail == after.detail == 'sound'
    assert (bad.refusal, bad.time_ns) == ('bad_observations', 6)
    assert bad.detail == '/observations: cannot decode 11 bytes as starcal/msg/StarObservations'


@pytest.mark.parametrize('is_stated', [True, False])
def test_a_checksum_of_all_data_is_compared(tmp_path, is_stated) -> None:
    """A bit outside all messages: what a file states is checked, most recorders state none."""
    path = tmp_path / 'b.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream, enable_data_crcs=is_stated)
        writer.start('ros2', 'recorder')
        writer.finish()
    told: list[str] = []
    assert list(bag_reader.read_messages(path, None, told.append)) == []
    assert told == []
    path.write_bytes(path.read_bytes().replace(b'recorder', b'recordes'))
    assert list(bag_reader.read_messages(path, None, told.append)) == []
    assert len(told) == is_stated


@pytest.fixture(scope='module')
def small_chunks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typestore_module, '_CHUNK_BYTES', 800)
        folder = write_bag(tmp_path_factory.mktemp('bag') / 'small', images=8, size=8)
    return next(folder.glob('*.mcap'))


def test_what_follows_a_chunk_is_not_held_for_the_next(small_chunks) -> None:
    """Attachments and messages outside chunks may be gigabytes."""
    with small_chunks.open('rb') as stream:
        records = list(StreamReader(stream, emit_chunks=True).records)
    end = next(record for record in records if isinstance(record, DataEnd))
    chunk = next(record for record in records if isinstance(record, Chunk))
    taken = []

    def file() -> Iterator[McapRecord]:
        for record in (chunk, *[Metadata('name', {})] * 100, end):
            taken.append(record)
            yield record

    pieces = bag_reader._decompressed(file(), io.BytesIO())
    next(pieces)
    assert len(taken) == 2
    pieces.close()  # type: ignore[attr-defined]


def test_a_flipped_bit_loses_one_chunk_only(tmp_path, small_chunks) -> None:
    """Without the first chunk, which holds the topic names, the other chunks are read."""
    whole = bytearray(small_chunks.read_bytes())
    with small_chunks.open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) > 8
    first = summary.chunk_indexes[0]
    file = tmp_path / 'flipped.mcap'
    # In its length, which hides all chunks up to the next one in the summary, and in its content.
    for offset in (5, first.chunk_length // 2):
        damaged = bytearray(whole)
        damaged[first.chunk_start_offset + offset] ^= 4
        file.write_bytes(damaged)
        said: list[str] = []
        assert len(attitudes_of(file, said.append)) == 15
        assert said[-1].endswith('lost 1 of 16 on /attitude')
        assert len(images_of(file, on_damage=said.append)) == 8
        assert bag_reader.choose_topic([file], ATTITUDE_TYPE) == '/attitude'


@pytest.mark.slow
@settings(max_examples=250)
@given(data=st.data())
def test_damage_is_always_reported(small_chunks, data) -> None:
    """Messages read are those written; each loss is one line, exact if the summary is intact."""
    whole = small_chunks.read_bytes()
    sound = list(bag_reader.read_raw([small_chunks]))
    with small_chunks.open('rb') as stream:
        records = StreamReader(stream).records
        summary_start = next(r.summary_start for r in records if isinstance(r, Footer))
    offsets = st.integers(8, len(whole) - 1)
    flips = data.draw(st.lists(st.tuples(offsets, st.integers(0, 7)), max_size=3, unique=True))
    size = data.draw(st.one_of(st.just(len(whole)), offsets))
    burst, at = data.draw(st.binary(max_size=64)), data.draw(st.integers(8, len(whole) - 64))
    damaged = bytearray(whole)
    damaged[at : at + len(burst)] = burst
    for offset, bit in flips:
        damaged[offset] ^= 1 << bit
    file = small_chunks.with_name('damaged.mcap')
    file.write_bytes(damaged[:size])
    said: list[str] = []
    read = list(bag_reader.read_raw([file], on_damage=said.append))
    left = iter(sound)
    assert all(any(message == one for one in left) for message in read), 'in order, as written'
    missing = len(sound) - len(read)
    assert said or not missing
    assert all('\n' not in text for text in said)
    ends = [at + len(burst), *(offset for offset, _ in flips)]
    if size == len(whole) and max(ends) < summary_start:
        counted = [int(n) for text in said for n in re.findall(r'(\d+) of \d+ on ', text)]
        assert sum(counted) == missing
    bag_reader.topics([file], said.append)


@pytest.mark.parametrize('indexed', [False, True])
def test_other_writers(tmp_path, indexed) -> None:
    """A file without chunks or summary is read; a channel that is not ROS 2 is skipped."""
    file = tmp_path / 'plain.mcap'
    store = typestore()
    message = image_to_message(Image(5, np.ones((2, 2), np.uint8)), '', make_message)
    with file.open('wb') as stream:
        writer = Writer(
            stream, use_chunking=indexed, use_statistics=indexed, compression=CompressionType.NONE
        )
        writer.start()
        definition, _ = store.generate_msgdef(IMAGE_TYPE, ros_version=2)
        schema = writer.register_schema(IMAGE_TYPE, 'ros2msg', definition.encode())
        image = writer.register_channel('/image', 'cdr', schema)
        other = writer.register_channel('/other', 'json', 0)
        writer.add_message(other, 1, b'{}', 1)
        writer.add_message(image, 5, bytes(store.serialize_cdr(message, IMAGE_TYPE)), 5)
        writer.finish()
    assert [t.name for t in bag_reader.topics([file])] == ['/image']
    (read,) = images_of(file)
    assert isinstance(read, Image) and read.time_ns == 5


@pytest.mark.parametrize(
    ('profile', 'encoding', 'said'),
    [
        ('ros1', 'ros1', 'an MCAP of ROS 1 messages: convert .* rosbags-convert --src'),
        ('', 'ros1', 'an MCAP of ROS 1 messages'),
        ('ros1', 'json', 'an MCAP of ROS 1 messages'),
        ('', 'json', r'\(topics: none in cdr, the encoding of ROS 2\)'),
    ],
)
@pytest.mark.parametrize('is_cut', [False, True])
def test_a_bag_without_ros_2_messages_is_named(tmp_path, profile, encoding, said, is_cut) -> None:
    """As those that other tools make of ROS 1 bags."""
    with (tmp_path / 'b.mcap').open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile)
        schema = writer.register_schema('sensor_msgs/Image', 'ros1msg', b'uint32 height')
        writer.add_message(writer.register_channel('/image', encoding, schema), 1, b'', 1)
        writer.finish()
    if is_cut and profile:  # without a summary
        content = (tmp_path / 'b.mcap').read_bytes()
        (tmp_path / 'b.mcap').write_bytes(content[:-30])
    with pytest.raises(BagError, match=said):
        bag_reader.choose_topic([tmp_path / 'b.mcap'], IMAGE_TYPE)


def test_messages_compressed_one_by_one_are_read(tmp_path, folder, monkeypatch) -> None:
    """As by ``ros2 bag record --compression-mode message``; damaged ones are counted as ever."""
    sound = list(bag_reader.read_raw([folder], ['/image', '/attitude']))
    (tmp_path / 'bag').mkdir()
    with (tmp_path / 'bag/bag_0.mcap').open('wb') as stream:
        writer = typestore_module.started(stream)
        numbers: dict[str, int] = {}
        for raw in sound:
            if raw.topic not in numbers:
                numbers[raw.topic] = typestore_module.opened(writer, raw.topic, raw.type_name)
            writer.add_message(numbers[raw.topic], 5, zstandard.compress(raw.data), 5)
        writer.add_message(numbers['/image'], 5, zstandard.compress(bytes(100))[:-9], 5)
        writer.finish()
    files = {'relative_file_paths': ['bag_0.mcap'], 'compression_mode': 'MESSAGE'}
    (tmp_path / 'bag/metadata.yaml').write_text(
        yaml.safe_dump({'rosbag2_bagfile_information': files})
    )
    for path in (tmp_path / 'bag', tmp_path / 'bag/bag_0.mcap'):
        read = list(bag_reader.read_raw([path]))
        assert [one.data for one in read[:-1]] == [one.data for one in sound]
        *images, last = images_of(path)
        assert all(isinstance(image, Image) for image in images)
        assert isinstance(last, StarObservations) and last.refusal == 'bad_layout'
    # One that claims to be larger is not inflated.
    monkeypatch.setattr(bag_reader, 'ARCHIVE_BYTES', 600 * 602 * 2)
    assert not any(isinstance(image, Image) for image in images_of(tmp_path / 'bag'))


@pytest.mark.parametrize(
    ('name', 'images', 'shape', 'dtype'),
    [
        ('independent/small_101.mcap', 16, (1024, 1296), np.uint16),
        ('realsky/granasat', 11, (960, 1280), np.uint8),
    ],
)
def test_bags_of_others(name, images, shape, dtype) -> None:
    said: list[str] = []
    path = SHARED / name
    if not path.exists():
        pytest.skip(f'{name} is not on this machine')
    topic = bag_reader.choose_topic([path], IMAGE_TYPE)
    found = list(bag_reader.read_images([path], topic, on_damage=said.append))
    assert len(found) == images
    for image in found:
        assert isinstance(image, Image)
        assert (image.pixels.shape, image.pixels.dtype) == (shape, dtype)
    attitude_topic = bag_reader.choose_topic([path], ATTITUDE_TYPE)
    assert len(attitudes_of(path, said.append, attitude_topic)) == 2 * images
    assert not said
