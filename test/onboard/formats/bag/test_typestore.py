# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Definitions of messages in bags: bounded before code is made from them."""

from __future__ import annotations

import pytest
from rosbags.typesys import get_typestore, Stores

from starcal_ros.formats.bag.typestore import (
    check_definition,
    described,
    store_with,
    typestore,
    typestore_of,
)
from starcal_ros.formats.messages.message_codec import CALIBRATION_TYPE, OBSERVATIONS_TYPE

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
    assert typestore_of(OBSERVATIONS_TYPE, definition) is store_with(OBSERVATIONS_TYPE)


def test_a_type_of_others_is_that_of_ros_whatever_its_bag_says() -> None:
    for type_name in (
        'sensor_msgs/msg/Image',
        'starcal/msg/Other',
        "starcal/msg/X'); import os; ('",
    ):
        assert typestore_of(type_name, 'int8 x\n') is typestore()


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
