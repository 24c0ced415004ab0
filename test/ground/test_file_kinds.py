# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What people give in place of an MCAP bag: it is named, with a command that helps and runs."""

import contextlib
from pathlib import Path
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys

from mission_files import TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader
from starcal_ground.file_kinds import explained, matching
from starcal_ground.images.photographs import image_paths
from starcal_ros.errors import BagError
from starcal_ros.formats.messages.message_codec import ATTITUDE_TYPE
from starcal_ros.records import Image

ATTITUDE = np.array([0.0, 0.0, 0.0, 1.0])


def attitude(store, k: int, **header):
    stamp = store.types['builtin_interfaces/msg/Time'](1_800_000_000 + k, 0)
    quaternion = store.types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    made = store.types['std_msgs/msg/Header'](stamp=stamp, frame_id='icrf', **header)
    return store.types[ATTITUDE_TYPE](made, quaternion)


def write_sqlite(folder: Path) -> None:
    """Write a bag as `ros2 bag record -a` of Humble does, which keeps no definitions of types."""
    store = get_typestore(Stores.ROS2_JAZZY)
    own = get_typestore(Stores.EMPTY)
    own.register(get_types_from_msg('float64 volt', 'power_msgs/msg/Battery'))
    with Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topic = bag.add_connection('/star tracker/attitude', ATTITUDE_TYPE, typestore=store)
        event_type = 'rcl_interfaces/msg/ParameterEvent'
        events = bag.add_connection('/parameter_events', event_type, typestore=store)
        power = bag.add_connection('/battery', 'power_msgs/msg/Battery', typestore=own)
        for k in range(3):
            data = store.serialize_cdr(attitude(store, k), ATTITUDE_TYPE)
            bag.write(topic, 1_800_000_000_000_000_000 + k, data)
            bag.write(events, 1_800_000_000_000_000_000 + k, bytes(40))
            bag.write(power, 1_800_000_000_000_000_000 + k, bytes(12))
    (file,) = folder.glob('*.db3')
    with contextlib.closing(sqlite3.connect(file)) as base:
        base.executescript('DROP TABLE message_definitions; UPDATE schema SET schema_version = 3')
    metadata = folder / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('version: 8', 'version: 5'))


def write_ros_1(path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as bag:
        topic = bag.add_connection('/attitude', ATTITUDE_TYPE, typestore=store)
        for k in range(3):
            data = store.serialize_ros1(attitude(store, k, seq=k), ATTITUDE_TYPE)
            bag.write(topic, 1_800_000_000_000_000_000 + k, data)


def write_compressed(folder: Path) -> None:
    """Write a bag as `ros2 bag record --compression-mode file` does."""
    shutil.copytree(TINY, folder)
    (bag,) = folder.glob('*.mcap')
    subprocess.run(['zstd', '-q', '--rm', bag, '-o', f'{bag}.zstd'], check=True)
    metadata = folder / 'metadata.yaml'
    text = metadata.read_text().replace(bag.name, f'{bag.name}.zstd')
    metadata.write_text(re.sub("compression_mode: ''", 'compression_mode: FILE', text))
    assert 'FILE' in metadata.read_text()


def write_compressed_file(path: Path) -> None:
    """Write the file of such a bag, without its folder."""
    subprocess.run(['zstd', '-q', TINY / 'tiny_0.mcap', '-o', path], check=True)


def run_remedy(words: str, folder: Path) -> None:
    """Run the command that an error message names."""
    command = re.search(r'((rosbags-convert|zstd) .*?)( makes one)?$', words)
    assert command is not None, words
    scripts = str(Path(sys.executable).parent)
    environment = {'PATH': f'{scripts}:/usr/bin:/bin'}
    done = subprocess.run(
        command[1], shell=True, cwd=folder, env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()[-500:]


@pytest.mark.parametrize(
    ('write', 'name', 'read'),
    [
        (write_sqlite, 'a flight', 'a flight_mcap'),
        (write_sqlite, 'flight/*.db3', 'flight_mcap'),
        (write_ros_1, 'a.bag', 'a_mcap'),
        (write_compressed, 'flight', 'flight'),
        (write_compressed_file, 'a flight.mcap.zstd', 'a flight.mcap'),
    ],
)
def test_the_command_that_is_named_makes_a_bag_that_is_read(write, name, read, tmp_path) -> None:
    if 'compressed' in write.__name__ and shutil.which('zstd') is None:
        pytest.skip('zstd is not installed')
    write(tmp_path / name.partition('/')[0])
    (given,) = tmp_path.glob(name)
    with pytest.raises(BagError) as error:
        reader.topics([given])
    words = explained(error.value)
    assert '\n' not in words
    assert ("--include-topic '/star tracker/attitude'" in words) == (write is write_sqlite)
    run_remedy(words, tmp_path)
    assert any(topic.type_name == ATTITUDE_TYPE for topic in reader.topics([tmp_path / read]))


@pytest.mark.parametrize(
    ('name', 'start', 'kind'),
    [('a.jpg', b'\xff\xd8\xff', 'a JPEG'), ('a.fits', b'SIMPLE  =', 'a FITS file')],
)
@pytest.mark.parametrize('in_a_folder', [False, True])
def test_an_image_in_place_of_a_bag_is_named_with_the_commands_that_take_it(
    name, start, kind, in_a_folder, tmp_path
) -> None:
    (tmp_path / name).write_bytes(start + bytes(40))
    with pytest.raises(BagError) as error:
        reader.topics([tmp_path if in_a_folder else tmp_path / name])
    said = explained(error.value)
    assert f'{kind}: starcal calibrate, diagnose and plan take images' in said
    assert in_a_folder == ('no .mcap files in the folder, but' in said)


@pytest.mark.parametrize('order', [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_files_are_read_in_the_order_of_their_first_messages(order, tmp_path) -> None:
    """A shell gives rec_10 before rec_2."""
    pixels = np.zeros((4, 4), np.uint8)
    names = ['rec_2.mcap', 'rec_10.mcap', 'rec_11.mcap']
    for k, name in enumerate(names):
        with BagWriter(tmp_path / name) as bag:
            bag.write_image('/image', Image(1_800_000_000_000_000_000 + k, pixels), 'camera')
    # A file that was cut off has no summary.
    cut = tmp_path / names[1]
    cut.write_bytes(cut.read_bytes()[:-40])
    given = [tmp_path / names[k] for k in order]
    stamps = [image.time_ns for image in reader.read_images(given, '/image')]
    assert stamps == sorted(stamps) and len(stamps) == 3
    assert reader.mcap_files([tmp_path, *given]) == [tmp_path / name for name in names]


@pytest.mark.parametrize(
    ('pattern', 'names'),
    [
        ('night[1]', ['night[1]']),
        ('night[1]/*.png', ['night[1]/a.png', 'night[1]/b.png']),
        ('night[1]/a.png', ['night[1]/a.png']),
        ('night[1]/a[1].png', []),
        ('night?1?/[ab].png', ['night[1]/a.png', 'night[1]/b.png']),
        ('night[2]/*.png', []),
        ('night2', ['night2']),
    ],
)
def test_a_folder_that_exists_is_no_pattern(tmp_path, pattern, names) -> None:
    (tmp_path / 'night[1]').mkdir()
    for name in ('a.png', 'b.png'):
        (tmp_path / 'night[1]' / name).touch()
    assert matching(tmp_path / pattern) == [tmp_path / name for name in names]


def test_a_folder_of_folders_with_images_names_them(tmp_path) -> None:
    for night in ('a', 'b', 'no images'):
        (tmp_path / night).mkdir()
        (tmp_path / night / 'x.png').write_bytes(b'' if ' ' in night else b'\x89PNG\r\n\x1a\n')
    with pytest.raises(BagError) as error:
        reader.mcap_files([tmp_path])
    said = explained(error.value)
    assert said.endswith(f'but folders with images (a, b): give {shlex.quote(f"{tmp_path}/*")}')
    assert [path.parent.name for path in image_paths([tmp_path / '*'])] == ['a', 'b', 'no images']
