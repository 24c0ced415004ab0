# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes of other types in a bag, and colour images: chosen by the options."""

from __future__ import annotations

from pathlib import Path

import cv2
from mission_files import attitudes, images, TINY  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ground.bag_writer import BagWriter
from starcal_ros.errors import BagError
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import (
    ATTITUDE_TYPES,
    IMAGE_TYPE,
    make_header,
    quaternion_to_message,
    vector_to_message,
)
from starcal_ros.options import read_parameter_file
from starcal_ros.pipeline import topics
from starcal_ros.pipeline.setup import load_setup, NODES, Setup
from starcal_ros.pipeline.topics import Topics


def setup_with(**others: object) -> Setup:
    values = read_parameter_file(TINY / 'params.yaml', NODES)
    return load_setup({**values, 'camera_info_url': str(TINY / 'camera.yaml'), **others})


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two images as rgb8 (the stars in green) and the attitudes as TransformStamped."""
    zero = vector_to_message(np.zeros(3), make_message)
    with BagWriter(tmp_path / 'bag') as writer:
        for time_ns, xyzw in attitudes():
            message = make_message(
                ATTITUDE_TYPES['transform'],
                header=make_header(time_ns, 'icrf', make_message),
                child_frame_id='st',
                transform=make_message(
                    'geometry_msgs/msg/Transform',
                    translation=zero,
                    rotation=quaternion_to_message(xyzw, make_message),
                ),
            )
            writer.write('/attitude', ATTITUDE_TYPES['transform'], time_ns, message)
        for image in images()[:2]:
            height, width = image.pixels.shape
            grey = image.pixels >> 4 if image.pixels.dtype == np.uint16 else image.pixels
            grey = np.clip(grey, 0, 255).astype(np.uint8)
            black = np.zeros_like(grey)
            message = make_message(
                IMAGE_TYPE,
                header=make_header(image.time_ns, 'camera', make_message),
                height=height,
                width=width,
                encoding='rgb8',
                is_bigendian=0,
                step=3 * width,
                data=cv2.merge([black, grey, black]).reshape(-1),
            )
            writer.write('/image', IMAGE_TYPE, image.time_ns, message)
    return tmp_path / 'bag'


def test_stars_are_found_in_the_channel_and_with_the_transforms(bag: Path) -> None:
    setup = setup_with(attitude_message='transform', image_channel='green')
    chosen = topics.choose_topics([bag], Topics(), setup)
    assert chosen.attitude == '/attitude'
    records = list(topics.read([bag], chosen, setup))
    assert [record.refusal for record in records] == ['', '']
    # 8 of 16 bit are left: the faint stars are gone, 15 of 300 remain.
    assert min(len(record) for record in records) > 10


@pytest.mark.parametrize('asked', ['', 'attitude'])
def test_a_bag_of_transforms_has_no_attitudes_by_default(bag: Path, asked: str) -> None:
    """Without a setup too, as for `starcal inspect`."""
    for setup in (setup_with(), None):
        with pytest.raises(BagError, match='no topic.*QuaternionStamped') as caught:
            topics.choose_topics([bag], Topics(attitude=asked), setup)
        remedy = '/attitude is a TransformStamped: if it holds the attitudes, set attitude_message'
        assert f'{remedy}: transform' in str(caught.value)


def test_without_a_channel_the_refusal_names_the_option(bag: Path) -> None:
    setup = setup_with(attitude_message='transform')
    records = list(topics.read([bag], topics.choose_topics([bag], Topics(), setup), setup))
    assert {record.refusal for record in records} == {'bad_encoding'}
    assert 'image_channel' in records[0].detail
