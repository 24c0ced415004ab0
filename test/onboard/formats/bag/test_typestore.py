# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Definitions of messages in bags: bounded before code is made from them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rosbags.typesys import get_typestore, Stores
from sample_records import NEEDED, observations, with_needed_fields, zeroed  # type: ignore[import-not-found]

from starcal_ground.bags import reader
from starcal_ros.errors import BagError
from starcal_ros.formats.bag.typestore import (
    check_definition,
    described,
    make_message,
    serialised,
    started,
    store_with,
    typestore,
    typestore_of,
)
from starcal_ros.formats.messages.message_codec import CALIBRATION_TYPE, OBSERVATIONS_TYPE
from starcal_ros.formats.messages.record_messages import (
    checked_observations,
    observations_to_message,
)

END = '=' * 80
HEAD = 'std_msgs/Header header\n'


@pytest.mark.parametrize('type_name', [OBSERVATIONS_TYPE, CALIBRATION_TYPE])
@pytest.mark.parametrize(
    'more', ['', 'float64 a\n', 'string[] a\nuint8[<=9] b\n'], ids=['this', 'later', 'lists']
)
def test_the_definitions_of_versions_are_taken(type_name: str, more: str) -> None:
    definition = described(type_name)[0].replace(END, f'{more}{END}', 1)
    assert type_name in check_definition(type_name, definition)
    names = {name for name, _ in typestore_of(type_name, definition).fielddefs[type_name][1]}
    assert names >= {'header'} | ({'a'} if more else set())
    assert (typestore_of(type_name, definition) is store_with(type_name)) == (not more)


@pytest.mark.parametrize(
    ('definition', 'why'),
    [
        (f'{HEAD}float64[4294967295] x\n', 'x has another type'),
        (f'{HEAD}Foo x\n', 'x has another type'),
        (f'{HEAD}{END}\nMSG: starcal/Foo\nint8[999] a\n', 'Foo is no type'),
        (f'{HEAD}StarObservations[] x\n', 'x has another type'),
        ('int8 a\n' * 100_000, 'longer than'),
        (f'{HEAD}SigmaPart[] x\n{END}\nMSG: starcal/SigmaPart\nint8 X=1\n', 'x has another type'),
        (f'{HEAD}{END}\nMSG: starcal/SigmaPart\nint8 X=1\n', 'SigmaPart has no header, or no'),
        ('int8 x\n', 'no header'),
        (f'{HEAD}string width\n', 'width has another type'),
        ('no definition', 'no header'),
    ],
)
def test_others_are_refused(definition: str, why: str) -> None:
    with pytest.raises(Exception, match=why):
        check_definition(OBSERVATIONS_TYPE, definition)
    raw = reader.RecordedMessage('/o', OBSERVATIONS_TYPE, 0, memoryview(b''), definition)
    for read in (reader.decode, reader.cdr_of_this_version):
        with pytest.raises(BagError, match=f'^/o: .* as no version of starcal does: .*{why}'):
            read(raw)


def test_a_definition_that_differs_in_words_is_that_of_this_version() -> None:
    """Recorders write the file with its comments, or none for types that they do not find."""
    for definition in ('', f'# of the file\n\n{described(CALIBRATION_TYPE)[0]}'):
        assert typestore_of(CALIBRATION_TYPE, definition) is store_with(CALIBRATION_TYPE)


FIELDS = [name for name, _ in store_with(OBSERVATIONS_TYPE).fielddefs[OBSERVATIONS_TYPE][1]]


@pytest.mark.parametrize('lacking', FIELDS[1:])
def test_a_message_of_another_version_is_read_and_has_zeros_for_ros(lacking: str) -> None:
    """All but the needed fields may lack: in a recording, in an object, and as zeros."""
    now = described(OBSERVATIONS_TYPE)[0]
    message = observations_to_message(observations(), 'camera', make_message)
    lines = [line for line in now.splitlines() if line.partition(' ')[2] != lacking]
    assert len(lines) == len(now.splitlines()) - 1
    definition = '\n'.join(lines).replace(END, f'float64 later\n{END}', 1)
    store = typestore_of(OBSERVATIONS_TYPE, definition)
    others = {name: getattr(message, name) for name in FIELDS if name != lacking}
    older = store.types[OBSERVATIONS_TYPE](**others, later=0.5)
    data = memoryview(store.serialize_cdr(older, OBSERVATIONS_TYPE))
    raw = reader.RecordedMessage('/observations', OBSERVATIONS_TYPE, 0, data, definition)
    zero = zeroed(getattr(message, lacking), f'[] {lacking}\n' in now)
    with_zero = serialised('', OBSERVATIONS_TYPE, replace(message, **{lacking: zero}))
    assert reader.cdr_of_this_version(raw) == with_zero
    of_ros = store_with(OBSERVATIONS_TYPE).deserialize_cdr(with_zero, OBSERVATIONS_TYPE)
    for there in (reader.decode(raw), SimpleNamespace(**others), of_ros):
        record = checked_observations(there)
        assert bool(record.refusal) == (lacking in NEEDED), record.detail
        assert lacking in record.detail or not record.refusal or there is of_ros


def test_the_needed_fields_alone_are_observations(tmp_path: Path) -> None:
    """A bag whose definition has them alone is read; what else there was is not known."""
    now, sent = described(OBSERVATIONS_TYPE)[0], observations()
    others = [name for name in FIELDS if name not in {*NEEDED, 'header'}]
    own, end, nested = now.partition(END)
    kept = [line for line in own.splitlines() if line.partition(' ')[2] not in others]
    definition = '\n'.join([*kept, end + nested])
    message = observations_to_message(sent, 'camera', make_message)
    store = typestore_of(OBSERVATIONS_TYPE, definition)
    fields = {name: getattr(message, name) for name in FIELDS if name not in others}
    data = store.serialize_cdr(store.types[OBSERVATIONS_TYPE](**fields), OBSERVATIONS_TYPE)
    with (tmp_path / 'needed.mcap').open('wb') as stream:
        writer = started(stream)
        schema = writer.register_schema(OBSERVATIONS_TYPE, 'ros2msg', definition.encode())
        writer.add_message(writer.register_channel('/o', 'cdr', schema), 1, bytes(data), 1)
        writer.finish()
    (record,) = reader.read_observations([tmp_path], '/o')
    assert record == with_needed_fields(sent)


def test_a_type_of_others_is_that_of_ros_whatever_its_bag_says() -> None:
    for name in ('sensor_msgs/msg/Image', 'starcal/msg/Other', "starcal/msg/X'); import os; ('"):
        assert typestore_of(name, 'int8 x\n') is typestore()


@pytest.mark.parametrize('release', [Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_the_types_are_those_of_the_ros_releases(release: Stores) -> None:
    theirs = get_typestore(release)
    shared = [name for name in typestore().types if not name.startswith('starcal/')]
    assert 'sensor_msgs/msg/CameraInfo' in shared and 'sensor_msgs/msg/Temperature' in shared
    assert store_with('sensor_msgs/msg/Temperature') is not typestore()
    for name in shared:
        whole = theirs.generate_msgdef(name, ros_version=2)[0], theirs.hash_rihs01(name)
        assert typestore().hash_rihs01(name) == whole[1]
        assert described(name) == whole  # of the few types, where it is one of them
