# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Definitions of messages in bags: bounded before code is made from them."""

from __future__ import annotations

import pytest
from rosbags.typesys import get_typestore, Stores

from starcal_ros.errors import BagError
from starcal_ros.formats.bag.typestore import described, typestore, typestore_of, typestore_with
from starcal_ros.formats.messages.message_codec import CALIBRATION_TYPE, OBSERVATIONS_TYPE

END = '=' * 80


@pytest.mark.parametrize('type_name', [OBSERVATIONS_TYPE, CALIBRATION_TYPE])
def test_the_definitions_of_this_version_are_taken(type_name: str) -> None:
    definition, _ = described(type_name)
    assert type_name in typestore_with(type_name, definition).types
    later = definition.replace(END, f'float64 of_a_later_version\n{END}', 1)
    assert later != definition
    assert type_name in typestore_with(type_name, later).types


@pytest.mark.parametrize(
    ('definition', 'why'),
    [
        ('float64[4294967295] x\n', 'an array of more than 1000 items'),
        (f'Foo[999] x\n{END}\nMSG: starcal/Foo\nint8[999] a\n', 'items'),
        ('int8 a\n' * 100_000, 'longer than'),
        ('starcal/StarObservations x\n', 'contains itself'),
        (f'Foo[] x\n{END}\nMSG: starcal/Foo\nint8 X=1\n', '0 items'),
        ('int8 x\n', 'no header'),
        ('std_msgs/Header header\nstring width\n', 'width has another type'),
        ('no definition', 'no header'),
    ],
)
def test_others_are_refused(definition: str, why: str) -> None:
    with pytest.raises(Exception, match=why):
        typestore_with(OBSERVATIONS_TYPE, definition)
    assert typestore_of(OBSERVATIONS_TYPE, definition) is typestore()
    with pytest.raises(
        BagError, match='starcal/msg/Other: its definition in the bag: longer than'
    ):
        typestore_of('starcal/msg/Other', 'int8 a\n' * 100_000)


def test_a_name_is_no_code() -> None:
    with pytest.raises(ValueError, match='not a type name'):
        typestore_with("starcal/msg/X'); import os; ('", 'int8 x\n')


@pytest.mark.parametrize('release', [Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_the_types_are_those_of_the_ros_releases(release: Stores) -> None:
    theirs = get_typestore(release)
    shared = [name for name in typestore().types if not name.startswith('starcal/')]
    assert 'sensor_msgs/msg/CameraInfo' in shared
    for name in shared:
        assert typestore().hash_rihs01(name) == theirs.hash_rihs01(name)
        assert described(name)[0] == theirs.generate_msgdef(name, ros_version=2)[0]
