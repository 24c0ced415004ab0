# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes of other types in a bag, and colour images."""

from pathlib import Path

import cv2
from mission_files import attitudes, images, TINY, write_encoded, write_tiny, write_unread  # type: ignore[import-not-found]
import numpy as np
import pytest
from sample_records import attitude_message  # type: ignore[import-not-found]
import yaml

from starcal_ground import calibrate_bag
from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader, topics
from starcal_ground.bags.topics import Topics
from starcal_ground.campaign import Source
from starcal_ground.cli.main import main
from starcal_ground.parameter_files import NODES, read_parameter_file, read_setup
from starcal_ground.simulation.simulated_bag import IMAGE_TOPIC
from starcal_ros.errors import BagError
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import (
    ALIGNMENT_TYPE,
    ATTITUDE_TYPE,
    IMU_TYPE,
    POSE_TYPE,
)
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import Image


def setup_with(**others: object) -> Setup:
    values = read_parameter_file(TINY / 'params.yaml', NODES)
    return load_setup({**values, 'camera_info_url': str(TINY / 'camera.yaml'), **others})


def test_stars_are_found_in_the_channel_and_with_the_transforms(tmp_path) -> None:
    """Of two images as rgb8 (the stars in green) and the attitudes as TransformStamped."""
    with BagWriter(tmp_path / 'bag') as writer:
        for time_ns, xyzw in attitudes():
            message = attitude_message(ALIGNMENT_TYPE, time_ns, xyzw)
            writer.write('/attitude', ALIGNMENT_TYPE, time_ns, message)
        for image in images()[:2]:
            green = np.clip(image.pixels >> 4, 0, 255).astype(np.uint8)
            black = np.zeros_like(green)
            colours = cv2.merge([black, green, black])
            write_encoded(writer, '/image', image, 'rgb8', colours)
    setup = setup_with(image_channel='green')
    chosen = topics.choose_topics([tmp_path / 'bag'], Topics(), setup)
    assert chosen.attitude == '/attitude'
    records = list(topics.read([tmp_path / 'bag'], chosen, setup))
    assert [record.refusal for record in records] == ['', '']
    # 8 of 16 bit are left: the faint stars are gone, 15 of 300 remain.
    assert min(len(record) for record in records) > 10
    # Images that cannot be decoded are chosen by their stamps too.
    wanted = images()[1].time_ns
    (record,) = topics.read([tmp_path / 'bag'], chosen, setup_with(), wanted=wanted.__eq__)
    assert (record.time_ns, record.refusal) == (wanted, 'bad_encoding')


SEVERAL = r'several topics may hold the attitudes: /a \(Imu\), /b \(PoseStamped\); choose'
NOT_READ = (
    'no topic of type .*QuaternionStamped.*; /a is a PoseWithCovarianceStamped, which is not read'
    ': publish its orientation as a QuaternionStamped or PoseStamped, and choose that with'
    ' --attitude-topic; starcal calibrate --camera-alone'
)


def with_topics(path: Path, kinds: dict[str, str], count: int = 1) -> list[Path]:
    """A bag of some images and of topics with a message each, which nobody decodes."""
    with BagWriter(path) as writer:
        for image in images()[:count]:
            writer.write_image(IMAGE_TOPIC, image, 'camera')
        for name, kind in kinds.items():
            write_unread(writer, name, kind)
    return [path]


@pytest.mark.parametrize(
    ('kinds', 'asked', 'chosen'),
    [
        ({'/a': ALIGNMENT_TYPE}, '', '/a'),
        ({'/a': ALIGNMENT_TYPE}, 'a', '/a'),
        ({'/a': IMU_TYPE, '/b': ATTITUDE_TYPE, '/c': POSE_TYPE}, '', '/b'),
        ({'/a': IMU_TYPE, '/b': ATTITUDE_TYPE}, 'a', '/a'),
    ],
)
def test_the_topic_of_the_attitudes_follows_from_the_types(tmp_path, kinds, asked, chosen) -> None:
    """Without a setup too, as for `starcal diagnose` where none is found."""
    bags = with_topics(tmp_path / 'bag', kinds)
    for setup in (setup_with(), None):
        assert topics.choose_topics(bags, Topics(attitude=asked), setup).attitude == chosen


@pytest.mark.parametrize(
    ('kinds', 'asked', 'said'),
    [
        ({'/a': IMU_TYPE, '/b': POSE_TYPE}, '', SEVERAL),
        ({'/a': ATTITUDE_TYPE, '/b': ATTITUDE_TYPE}, '', 'choose one with --attitude-topic$'),
        ({'/a': ATTITUDE_TYPE}, 'b', r'no topic b of type .*Stamped \(available: /a\)'),
        ({'/a': 'geometry_msgs/msg/PoseWithCovarianceStamped'}, '', NOT_READ),
    ],
)
def test_attitudes_that_are_not_chosen_are_named(tmp_path, kinds, asked, said) -> None:
    bags = with_topics(tmp_path / 'bag', kinds)
    for setup in (setup_with(), None):
        with pytest.raises(BagError, match=said):
            topics.choose_topics(bags, Topics(attitude=asked), setup)


def test_a_bag_cut_off_in_its_only_chunk_is_asked_for_whole(tmp_path) -> None:
    (cut := tmp_path / 'cut.mcap').write_bytes((TINY / 'tiny_0.mcap').read_bytes()[:900_000])
    said = 'truncated after byte 36 of 900000; .*; no sensor_msgs/msg/Image is left: give'
    with pytest.raises(BagError, match=f'^{cut}: {said} the whole file$'):
        topics.choose_topics([cut], Topics())


@pytest.mark.parametrize(
    ('kind', 'is_named'),
    [
        ('tf2_msgs/msg/TFMessage', True),
        ('nav_msgs/msg/Odometry', True),
        ('px4_msgs/msg/VehicleAttitude', True),
        ('geometry_msgs/msg/PoseWithCovarianceStamped', True),
        ('sensor_msgs/msg/Temperature', False),
    ],
)
def test_attitudes_that_are_not_read_are_named_where_none_are_asked_for(
    tmp_path, caplog, kind, is_named
) -> None:
    """Without parameters the camera was found by its stars, and nothing was said of them."""
    reader.log_damage.cache_clear()
    assert topics.without_attitudes(with_topics(tmp_path / 'bag', {'/a': kind}), Topics(), {})
    said = f'/a is a {kind.rpartition("/")[2]}, which is not read: publish its orientation as a'
    assert (said in caplog.text) is is_named


def test_images_in_another_order_are_all_used(tmp_path) -> None:
    """Six of ten were: each third image after one of a later stamp began a sequence."""
    paths = [write_tiny(tmp_path / 'bag', [images()[k] for k in (3, 0, 2, 1)])]
    setup = setup_with()
    records = list(topics.read(paths, topics.choose_topics(paths, Topics(), setup), setup))
    expected = [images()[k].time_ns for k in (3, 0, 1, 2)]
    assert [(record.time_ns, record.refusal) for record in records] == [(t, '') for t in expected]


@pytest.mark.parametrize('stray', ['', '/attitude', '/image', '/velocity'])
@pytest.mark.parametrize('is_first', [True, False])
def test_messages_of_another_type_on_a_topic_are_left_out_and_named(
    tmp_path, caplog, stray, is_first
) -> None:
    """They hid the attitudes, ended in a traceback or were counted as images."""
    reader.log_damage.cache_clear()
    text = make_message('std_msgs/msg/String', data='stray')
    velocity_m_s = np.array([0.0, 3e4, 0.0])
    with BagWriter(tmp_path / 'bag') as writer:
        for step in range(3):
            if stray and step == (0 if is_first else 2):
                writer._channels.pop(stray, None)
                writer.write(stray, 'std_msgs/msg/String', 1, text)
                del writer._channels[stray]
            elif step == 1:
                for time_ns, xyzw in attitudes()[:4]:
                    writer.write_attitude('/attitude', time_ns, xyzw, 'icrf')
                writer.write_velocity('/velocity', images()[0].time_ns, velocity_m_s, 'icrf')
                writer.write_image('/image', images()[0], 'camera')
    bags, setup = [tmp_path / 'bag'], setup_with()
    chosen = topics.choose_topics(bags, Topics(), setup)
    assert chosen == Topics('/image', '/attitude', '/velocity')
    assert Source(tuple(bags), chosen, setup).image_count == 1
    (record,) = topics.read(bags, chosen, setup)
    assert not record.refusal and len(record) > 100
    said = [f'{stray}: 1 message of std_msgs/msg/String not read'] if stray else []
    assert caplog.messages == said


ODOMETRY, TF = 'nav_msgs/msg/Odometry', 'tf2_msgs/msg/TFMessage'


def params(folder: Path, **options: object) -> Path:
    path = folder / 'params.yaml'
    values = {'camera_info_url': str(TINY / 'camera.yaml'), **options}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    return path


STATED = {'prior_alignment': [0.0, 0.0, 0.0, 1.0], 'star_tracker_sigma_arcsec': [10.0, 10.0, 20.0]}


@pytest.mark.parametrize('stated', STATED)
@pytest.mark.parametrize('kind', [ODOMETRY, ''])
def test_a_stated_star_tracker_that_is_not_in_the_bag_is_an_error_of_every_command(
    kind, stated, tmp_path, starcal
) -> None:
    bag = with_topics(tmp_path / 'bag.mcap', {'/gnc/state': kind} if kind else {}, 4)[0]
    given = ['--params', str(params(tmp_path, **{stated: STATED[stated]}))]
    for command, status in (
        (['calibrate', bag, *given, '-o', tmp_path / 'out'], 2),
        (['diagnose', bag, *given], 3),
    ):
        answer = starcal(*command)
        said = ' '.join([answer.words, answer.err])
        assert answer.status == status
        assert 'record the attitudes of the star tracker' in said
        assert 'starcal calibrate --camera-alone' in said
        assert ('/gnc/state' in said) is bool(kind)


@pytest.mark.parametrize(
    ('kind', 'options'),
    [(ODOMETRY, []), ('', ['PARAMS']), (TF, ['PARAMS', '--camera-alone'])],
)
@pytest.mark.slow
def test_diagnose_takes_images_without_attitudes_where_calibrate_does(
    kind, options, tmp_path, starcal
) -> None:
    bag = with_topics(tmp_path / 'bag.mcap', {'/gnc/state': kind} if kind else {}, 4)[0]
    stated = STATED if '--camera-alone' in options else {}
    words = {'PARAMS': ['--params', str(params(tmp_path, **stated))]}
    given = [word for option in options for word in words.get(option, [option])]
    status, said, _ = starcal('diagnose', bag, *given)
    assert status == 0
    assert '4 of 4 images' in said and 'the camera alone can be calibrated' in said


@pytest.mark.slow
@pytest.mark.parametrize('with_attitudes', [False, True])
def test_the_camera_alone_is_calibrated_where_requested(with_attitudes, tmp_path, starcal) -> None:
    path, other = tmp_path / 'bag.mcap', {'/gnc/state': ODOMETRY}
    bag = write_tiny(path, images()[:4]) if with_attitudes else with_topics(path, other, 4)[0]
    given = ['--params', TINY / 'params.yaml']
    answer = starcal('calibrate', bag, '--camera-alone', '-o', tmp_path / 'out', *given)
    assert answer.status in (0, 3)
    made = read_calibration(tmp_path / 'out' / 'calibration.json')
    assert not made.has_alignment
    assert 'not used, since the attitudes are those of the stars: prior' in answer.err
    # Its observations say so: repeated from them, it gained the alignment to a star tracker.
    out, again = str(tmp_path / 'out/observations.mcap'), str(tmp_path / 'again')
    assert starcal('calibrate', out, *given, '-o', again).status in (0, 3)
    repeated = read_calibration(tmp_path / 'again/calibration.json')
    assert not repeated.has_alignment
    name = 'observations_sha256'
    assert repeated.provenance[name] == made.provenance[name]
    assert calibrate_bag(out, TINY / 'params.yaml').provenance[name] == made.provenance[name]
    recorded, setup = Topics(observations='/observations'), read_setup(TINY / 'params.yaml')
    with pytest.raises(BagError, match='of a camera alone, where a star tracker is set up'):
        list(topics.read([Path(out)], recorded, setup))


@pytest.mark.parametrize('command', ['diagnose', 'diagnose --params', 'calibrate --params'])
def test_a_clock_that_was_never_set_is_named(command, tmp_path, caplog) -> None:
    reader.log_damage.cache_clear()
    bag = tmp_path / 'bag.mcap'
    back_ns = images()[0].time_ns - 5 * 10**9
    unset = (Image(image.time_ns - back_ns, image.pixels) for image in images()[:2])
    samples = ((ns - back_ns, xyzw) for ns, xyzw in attitudes() if ns > back_ns)
    write_tiny(bag, unset, samples)
    name, *with_params = command.split()
    given = [*with_params, str(TINY / 'params.yaml')] if with_params else []
    out = ['-o', str(tmp_path / 'out'), '--no-report'] if name == 'calibrate' else []
    main([name, str(bag), *given, *out])
    words = [text for text in caplog.messages if 'the clock was not set' in text]
    assert len(words) == 1 and 'stamp images and attitudes in UTC' in words[0]
