# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A star tracker that is stated and not in the bag: an error, alike in all commands."""

from __future__ import annotations

from pathlib import Path

from mission_files import attitudes, images, TINY, write_tiny, write_unread  # type: ignore[import-not-found]
import pytest
import yaml

from starcal_ground import calibrate_bag
from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader, topics
from starcal_ground.bags.topics import Topics
from starcal_ground.cli.main import main
from starcal_ground.simulation.simulated_bag import IMAGE_TOPIC
from starcal_ros.errors import BagError
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.pipeline.setup import read_setup
from starcal_ros.records import Image

ODOMETRY, POSE, TF = (
    'nav_msgs/msg/Odometry',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'tf2_msgs/msg/TFMessage',
)


def write_bag(path: Path, kind: str) -> Path:
    """Write four images, and attitudes in messages of a type that is not read; empty: none."""
    with BagWriter(path) as writer:
        for image in images()[:4]:
            writer.write_image(IMAGE_TOPIC, image, 'camera')
        if kind:
            write_unread(writer, '/gnc/state', kind)
    return path


def params(folder: Path, **options: object) -> Path:
    path = folder / 'params.yaml'
    values = {'camera_info_url': str(TINY / 'camera.yaml'), **options}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    return path


STATED = {
    'prior_alignment': [0.0, 0.0, 0.0, 1.0],
    'star_tracker_sigma_arcsec': [10.0, 10.0, 20.0],
}


@pytest.mark.parametrize('stated', STATED)
@pytest.mark.parametrize('kind', [ODOMETRY, POSE, TF, ''])
def test_a_stated_star_tracker_that_is_not_in_the_bag_is_an_error_of_every_command(
    kind: str, stated: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', kind)
    given = ['--params', str(params(tmp_path, **{stated: STATED[stated]}))]
    for command, status in (
        (['calibrate', str(bag), *given, '-o', str(tmp_path / 'out')], 2),
        (['diagnose', str(bag), *given], 3),
    ):
        assert main(command) == status
        said = ' '.join(' '.join(capsys.readouterr()).split())
        assert 'record the attitudes of the star tracker' in said
        assert 'starcal calibrate --camera-alone' in said
        if kind:
            name = kind.rpartition('/')[2]
            assert f'/gnc/state is a {name}, which is not read: publish its orientation' in said


@pytest.mark.parametrize(
    ('kind', 'options'),
    [
        ('', []),
        (ODOMETRY, []),
        ('', ['PARAMS']),
        (TF, ['PARAMS', '--camera-alone']),
    ],
)
@pytest.mark.slow
def test_diagnose_takes_images_without_attitudes_where_calibrate_does(
    kind: str, options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / 'bag.mcap', kind)
    stated = STATED if '--camera-alone' in options else {}
    words = {'PARAMS': ['--params', str(params(tmp_path, **stated))]}
    given = [word for option in options for word in words.get(option, [option])]
    assert main(['diagnose', str(bag), *given]) == 0
    said = capsys.readouterr().out
    assert '4 of 4 images' in said and 'the camera alone can be calibrated' in said


@pytest.mark.slow
@pytest.mark.parametrize('with_attitudes', [False, True])
def test_the_camera_alone_is_calibrated_where_it_is_requested(
    with_attitudes: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = TINY if with_attitudes else write_bag(tmp_path / 'bag.mcap', ODOMETRY)
    command = ['calibrate', str(bag), '--camera-alone', '-o', str(tmp_path / 'out')]
    given = ['--params', str(TINY / 'params.yaml')]
    assert main([*command, *given]) in (0, 3)
    made = read_calibration(tmp_path / 'out' / 'calibration.json')
    assert not made.has_alignment
    assert 'not used, since the attitudes are those of the stars: prior' in capsys.readouterr().err
    # Its observations say so: repeated from them, it gained the alignment to a star tracker.
    out, again = str(tmp_path / 'out/observations.mcap'), str(tmp_path / 'again')
    assert main(['calibrate', out, *given, '-o', again]) in (0, 3)
    repeated = read_calibration(tmp_path / 'again/calibration.json')
    assert not repeated.has_alignment
    name = 'observations_sha256'
    assert repeated.provenance[name] == made.provenance[name]
    assert calibrate_bag(out, TINY / 'params.yaml').provenance[name] == made.provenance[name]
    recorded, setup = Topics(observations='/observations'), read_setup(TINY / 'params.yaml')
    with pytest.raises(BagError, match='of a camera alone, where a star tracker is set up'):
        list(topics.read([Path(out)], recorded, setup))


@pytest.mark.parametrize('command', ['diagnose', 'diagnose --params', 'calibrate --params'])
def test_a_clock_that_was_never_set_is_named(
    command: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
    words = [
        record.message for record in caplog.records if 'the clock was not set' in record.message
    ]
    assert len(words) == 1 and 'stamp images and attitudes in UTC' in words[0]
