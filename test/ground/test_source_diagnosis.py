# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What is said of a bag before it is calibrated, held against what a calibration then does."""

from collections import Counter
import contextlib
import dataclasses
import json
import math
from pathlib import Path

from mission_files import attitudes, params_with, TINY, write_compressed, write_tiny  # type: ignore[import-not-found]
from mission_files import images as tiny_images
import numpy as np
import pytest

from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import topics
from starcal_ground.bags.topics import Topics
from starcal_ground.campaign import Source
from starcal_ground.cli.arguments import EXIT_REFUSED
from starcal_ground.diagnosis.attitude_readings import wire_attitudes
from starcal_ground.diagnosis.bags import refusals
from starcal_ground.diagnosis.diagnose import Diagnosis, found_alignment
from starcal_ground.parameter_files import read_setup
from starcal_ground.simulation import simulated_bag
from starcal_ground.source_diagnosis import Contents, examine, without_setup
from starcal_ros.errors import BagError, OptionError
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import Image, refused_image
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory

PARAMS = TINY / 'params.yaml'
ASKED = Topics()
ALONE = [(5, np.array([0.0, 0.0, 0.0, 1.0]))]  # no attitude of the images
IMAGE, ATTITUDE = simulated_bag.IMAGE_TOPIC, simulated_bag.ATTITUDE_TOPIC


@pytest.fixture(scope='module')
def setup() -> Setup:
    return read_setup(PARAMS)


@pytest.mark.parametrize(
    ('step_deg', 'words'),
    [
        # The middle of the field from RA 0 to 0.9, and a field more: CONE_MARGIN_RAD on each side.
        (0.1, '0.1 stars; needed: RA 0.45, Dec +1.00, radius 0.84 deg, of 10 images'),
        (30.0, 'needed: RA 0.00, Dec +1.00, radius 0.30 deg; others at RA 30.00, Dec +1.00; '),
        (30.0, '; RA 180.00, Dec +1.00; RA 210.00, Dec +1.00, and 2 more'),
    ],
)
def test_the_sky_that_a_catalog_lacks_is_named(step_deg, words) -> None:
    details = [
        f'0.1 stars; needed: RA {step_deg * k:.2f}, Dec +1.00, radius 0.30 deg' for k in range(10)
    ]
    images = [refused_image(k, 8, 8, 'not_in_catalog', detail) for k, detail in enumerate(details)]
    (group,) = refusals(images)
    assert words in group.detail


def contents_of(path: Path) -> Contents:
    """Contents of a bag of which nothing is stated, and whose camera is not found."""
    return without_setup([path], ASKED, OptionError('not found')).contents


@pytest.fixture(scope='module')
def spoilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """
    The tiny bag with an image of each fault: sky, stamp, size, attitude.

    Image 0 has lost the samples about it, image 1 those after it; image 3 comes twice; image 4 is
    dark; image 5 is cut; the samples about image 7 are no rotations; after image 9 the attitudes
    end, and one more image comes.
    """
    path: Path = tmp_path_factory.mktemp('bag') / 'spoilt.mcap'
    images: tuple[Image, ...] = tiny_images()
    stamps = [image.time_ns for image in images]

    def near(k: int, time_ns: int) -> bool:
        return abs(time_ns - stamps[k]) < 10**9

    with BagWriter(path) as writer:
        for time_ns, xyzw in attitudes():
            if near(0, time_ns) or (near(1, time_ns) and time_ns > stamps[1]):
                continue
            broken = near(7, time_ns)
            writer.write_attitude(ATTITUDE, time_ns, 0.5 * xyzw if broken else xyzw, 'icrf')
        for k, image in enumerate(images):
            pixels = image.pixels
            if k == 4:
                pixels = np.full_like(pixels, np.median(pixels))
            if k == 5:
                pixels = pixels[:-1]
            for _ in range(2 if k == 3 else 1):
                writer.write_image(IMAGE, Image(image.time_ns, pixels), 'camera')
        writer.write_image(IMAGE, Image(stamps[-1] + 10**10, images[-1].pixels), 'camera')
    return path


@pytest.mark.slow
def test_verdicts_are_those_of_the_calibration(spoilt, setup) -> None:
    quick = contents_of(spoilt)
    assert {r.reason: r.count for r in quick.refused} == {
        'no_attitude': 2,
        'attitude_gap': 1,
        'bad_attitude': 1,
        'out_of_order': 1,
    }
    assert quick.images == quick.looked_at == 12 and not quick.stars_per_image
    seen = []
    progress = lambda count: contextlib.nullcontext(lambda: seen.append(count))  # noqa: E731
    examined = examine(Source((spoilt,), ASKED, setup), progress)
    full = examined.contents
    by_reason = {r.reason: r.count for r in full.refused}
    # With the stars and the camera, two more: the dark image and the cut one.
    expected = {r.reason: r.count for r in quick.refused} | {'blank': 1, 'wrong_size': 1}
    assert by_reason == expected
    assert seen == 12 * [12] and full.images == full.looked_at == 12
    observed = list(topics.read([spoilt], Topics(IMAGE, ATTITUDE), setup))
    assert by_reason == Counter(o.refusal for o in observed if o.refusal)
    assert full.stars_per_image == tuple(len(o) for o in observed if not o.refusal)
    gap = next(r for r in full.refused if r.reason == 'attitude_gap')
    assert gap.first_ns == tiny_images()[1].time_ns and 'over 2 s' in gap.detail
    assert len(full.stars_per_image) == 5 and examined.diagnosis.cause == 'none'
    assert full.longest_attitude_gap_s == max(o.attitude_gap_s for o in observed if not o.refusal)


def test_an_attitude_gap_that_is_not_recorded_is_nan(tmp_path, starcal) -> None:
    """An image without attitudes on both sides has no gap; JSON, which has no NaN, holds null."""
    path = write_tiny(tmp_path / 'images.mcap', tiny_images()[:1], ALONE)
    assert math.isnan(contents_of(path).longest_attitude_gap_s)
    status, out, _ = starcal('diagnose', path, '--json')
    assert json.loads(out)['contents']['longest_attitude_gap_s'] is None
    assert status == EXIT_REFUSED
    status, out, _ = starcal('diagnose', path)
    assert status == EXIT_REFUSED and 'longest attitude gap' not in out


def test_the_topics_are_told_also_of_a_cut_bag(spoilt, tmp_path) -> None:
    attitude, image = sorted(contents_of(spoilt).topics, key=lambda t: -t.bad)
    assert (attitude.name, attitude.bad) == (ATTITUDE, 4)
    assert attitude.rate_hz == pytest.approx(2.0) and attitude.count == 34
    assert image.name == IMAGE and image.count == 12 and image.bad == 0
    assert image.kinds == {'mono16 640 x 512': 11, 'mono16 640 x 511': 1}
    assert image.rate_hz == pytest.approx(0.25) and image.longest_gap_s == pytest.approx(10.0)
    assert image.first_ns == tiny_images()[0].time_ns
    assert image.last_ns == tiny_images()[-1].time_ns + 10**10
    # A cut one is read as far as it goes.
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(spoilt.read_bytes()[:-10_000])  # in the second chunk
    found = contents_of(cut)
    (damage,) = found.damage
    assert 'truncated' in damage
    (images,) = (t.count for t in found.topics if t.name == IMAGE)
    assert 0 < images < 10 and found.images == images


def test_what_the_bag_holds_besides_is_listed_and_told_by_recording_time(tmp_path) -> None:
    path = tmp_path / 'more.mcap'
    with BagWriter(path) as writer:
        for k in (0, 2, 1):
            writer.write_temperature('/lens', 10**18 + k * 10**9, 20.0, 'camera')
            writer.write_velocity('/velocity', 10**18 + k * 10**9, np.zeros(3), 'icrf')
    with pytest.raises(BagError) as error:
        topics.choose_topics([path], ASKED)
    found = without_setup([path], ASKED, error.value)
    lens, velocity = found.contents.topics
    assert (lens.name, velocity.name) == ('/lens', '/velocity')
    assert lens.backward == 1 and lens.rate_hz == pytest.approx(1.0)
    sentence = found.diagnosis.sentence
    assert 'no topic of type sensor_msgs/msg/Image' in sentence
    assert 'starcal import' in sentence and '/lens' in sentence


def test_compressed_images_are_told_apart(tmp_path) -> None:
    path = tmp_path / 'png.mcap'
    with BagWriter(path) as writer:
        for image, ending in zip(tiny_images(), ('png', 'jpg', 'bmp'), strict=False):
            pixels = image.pixels if ending == 'png' else image.pixels.astype(np.uint8)
            write_compressed(writer, '/image', image, ending, pixels)
        for time_ns, xyzw in attitudes():
            writer.write_attitude(ATTITUDE, time_ns, xyzw, 'icrf')
    found = contents_of(path)
    (shown,) = (t for t in found.topics if t.name == '/image')
    kinds = {'PNG 640 x 512': 1, 'JPEG 640 x 512': 1, 'bmp, not a PNG or JPEG': 1}
    assert shown.kinds == kinds
    assert {r.reason: r.count for r in found.refused} == {'bad_encoding': 1}


def test_recorded_observations_need_no_parameters(tiny_products, starcal) -> None:
    path = tiny_products / 'observations.mcap'
    found = contents_of(path)
    assert found.stars_per_image and found.images == 10 and not found.refused
    assert found.chosen == Topics(observations='/observations')
    status, out, _ = starcal('diagnose', path, '--params', PARAMS)
    assert status == 0 and 'nothing to diagnose in recorded observations.' in out


@pytest.mark.slow
def test_the_tool_shows_the_verdicts_without_parameters(spoilt, starcal) -> None:
    status, out, _ = starcal('diagnose', spoilt)
    assert status == 0
    assert '5 of 12 images' in out and 'attitude_gap' in out
    assert 'over 2 s' in out and 'too far apart' in out  # this image's, and what it means


def test_a_bag_that_cannot_be_calibrated_ends_with_3(tmp_path, starcal) -> None:
    path = write_tiny(tmp_path / 'two.mcap', tiny_images()[:2], ALONE)
    status, out, _ = starcal('diagnose', path)
    assert status == 3
    assert 'Cannot be calibrated: 2 different images, 3 are needed' in out and 'no_attitude' in out
    few = write_tiny(tmp_path / 'few.mcap', tiny_images()[:2])
    status, out, _ = starcal('diagnose', few)
    assert status == 3 and '2 different images, 3 are needed' in out
    status, out, _ = starcal('diagnose', few, '--params', PARAMS)
    assert status == 3 and '1 more image (2 of 3 collected)' in out


@pytest.mark.slow
@pytest.mark.parametrize(
    ('direction', 'words'),
    [
        ('st_to_inertial', '10 of 12 images'),
        ('inertial_to_st', '0 of the first 10 of 12 images'),
    ],
)
def test_images_after_ten_that_show_a_wrong_set_up_are_not_measured(
    direction, words, tmp_path, starcal
) -> None:
    last = tiny_images()[-1]
    later = (Image(last.time_ns + k * 10**11, last.pixels) for k in (1, 2))
    path = write_tiny(tmp_path / 'more.mcap', later, ())
    params = params_with(tmp_path, attitude_direction=direction)
    answer = starcal('diagnose', TINY, path, '--params', params)
    assert answer.status == (3 if words.startswith('0') else 0) and words in answer.words


def test_two_images_are_too_few_for_an_alignment() -> None:
    two = Diagnosis('prior_alignment', [0.0, 0.0, 0.0, 1.0], 'x', images=2)
    assert found_alignment(two) == (None, '2 images agree, 3 are needed.')
    assert found_alignment(dataclasses.replace(two, images=3))[0] == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize('direction', ['st_to_inertial', 'inertial_to_st'])
def test_the_valid_attitudes_are_looked_at_as_they_were_received(direction) -> None:
    history = AttitudeHistory()
    assert wire_attitudes(history, direction).quaternion.shape == (0, 4)
    sent = {30: [0.6, 0, 0, 0.8], 20: [0, 0, 0, 0.5], 15: [np.nan] * 4, 10: [1.0, 0, 0, 0]}
    for time_ns, q in sent.items():
        history.add(time_ns, attitude_sample(time_ns, np.array(q), direction))
    kept = wire_attitudes(history, direction)
    assert kept.time_ns.tolist() == [10, 30]
    np.testing.assert_allclose(kept.quaternion, [sent[10], sent[30]], atol=1e-15)


@pytest.mark.slow
def test_unmatched_images_are_diagnosed_in_a_process_of_its_own(tmp_path, monkeypatch) -> None:
    # In the folder of an untrusted bag: nothing that lies there is imported.
    (tmp_path / 'cv2.py').write_text('raise SystemExit(9)')
    monkeypatch.chdir(tmp_path)
    answers: list[Diagnosis] = []
    stated = {'camera_info_url': str(TINY / 'camera.yaml'), 'attitude_direction': 'inertial_to_st'}
    finder = pytest.importorskip('starcal_ground.ros.setup_finder')  # of ROS
    unmatched = finder.Unmatched(load_setup(stated), AttitudeHistory(), answers.append)
    for image in tiny_images()[:3]:
        unmatched.add(image)
    assert unmatched._thread is not None
    unmatched._thread.join()
    assert [found.cause for found in answers] == ['no_attitude']
    assert answers[0].evidence[0].startswith('3 of 3 images identified without attitude')
    unmatched.close()
    unmatched.add(tiny_images()[0])
    unmatched._thread.join()
    assert len(answers) == 1
