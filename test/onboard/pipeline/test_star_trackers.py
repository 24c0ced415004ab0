# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A bag with the attitudes of two star trackers, from images to alignments."""

from collections import Counter
from pathlib import Path
from typing import Any

from mission_files import attitudes, images, TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import topics
from starcal_ground.bags.reader import log_damage
from starcal_ground.bags.topics import Topics
from starcal_ground.parameter_files import NODES, read_parameter_file
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import StarObservations

FIRST_FROM_OTHER = Rotation.from_euler('xyz', [100.0, -20.0, 35.0], degrees=True)
# Two pixels of this camera: the mounting as assumed is wrong by more than a star is wide.
WRONG = Rotation.from_rotvec(np.array([150.0, -100.0, 180.0]) * ARCSECOND_RAD)
VALUES = read_parameter_file(TINY / 'params.yaml', NODES)


def other_alignment() -> list[float]:
    """The alignment of the camera to the other star tracker as a user would give it."""
    first_from_camera = Rotation.from_quat(VALUES['prior_alignment'])
    return [float(x) for x in ((FIRST_FROM_OTHER * WRONG).inv() * first_from_camera).as_quat()]


def setup_with(**others: object) -> Setup:
    two = {'more_star_trackers': ['other'], 'more_alignments': other_alignment()}
    return load_setup({**VALUES, 'camera_info_url': str(TINY / 'camera.yaml'), **two, **others})


def bag_of(
    path: Path, first_until: float = 1.0, other_until: float = 1.0, absent: str = ''
) -> Path:
    """The small bag with a second star tracker; each repeats itself after a part of the time."""
    samples = attitudes()
    with BagWriter(path) as writer:
        for which, topic, mounted, until in (
            ('first', '/star_tracker/attitude', Rotation.identity(), first_until),
            ('other', '/other/attitude', FIRST_FROM_OTHER, other_until),
        ):
            if which == absent:
                continue
            last = int(until * (len(samples) - 1))
            for k, (time_ns, xyzw) in enumerate(samples):
                if until < 0.0 and k >= len(samples) // 2:
                    break  # silent, not stuck
                shown = samples[min(k, last)][1] if until >= 0.0 else xyzw
                quaternion = (Rotation.from_quat(shown) * mounted).as_quat()
                writer.write_attitude(topic, time_ns, quaternion, 'icrf')
        for image in images():
            writer.write_image('/image', image, 'camera')
    return path


def observed(bag: Path, setup: Setup) -> list[StarObservations]:
    return list(topics.read([bag], topics.choose_topics([bag], Topics(), setup), setup))


def used(records: list[StarObservations]) -> Counter[str]:
    return Counter(record.star_tracker for record in records if not record.refusal)


@pytest.mark.slow
@pytest.mark.parametrize(('which', 'until'), [('first', 0.0), ('other', -1.0)])
def test_one_that_falls_silent_or_repeats_itself_costs_no_image(tmp_path, which, until) -> None:
    end: dict[str, Any] = {f'{which}_until': until}
    bag = bag_of(tmp_path / 'two', **end)
    records = observed(bag, setup_with())
    assert [record.refusal for record in records] == [''] * 10
    lost, kept = ('', 'other') if which == 'first' else ('other', '')
    assert used(records)[lost] < 5 < used(records)[kept]


@pytest.mark.slow
def test_a_wrong_one_is_tried_seldom_and_costs_no_image(tmp_path: Path) -> None:
    """The alignment to the other star tracker is off by 5 degrees."""
    off = Rotation.from_euler('x', 5.0, degrees=True) * Rotation.from_quat(other_alignment())
    setup = setup_with(more_alignments=[float(x) for x in off.as_quat()])
    records = observed(bag_of(tmp_path / 'two'), setup)
    assert used(records) == {'': 10}
    details = [record.detail for record in records]
    # The first image is that of the first star tracker; then ten images count as one in vain.
    assert details[1].startswith('other not used: no_match: ')
    assert [bool(detail) for detail in details] == [k == 1 for k in range(10)]


@pytest.mark.parametrize(
    ('which', 'says'),
    [
        ('other', '/other/attitude: no such topic of attitudes;'),
        ('first', 'the first star tracker, star_tracker, is left out'),
    ],
)
def test_one_that_is_not_in_the_bag_is_named_and_the_rest_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, which: str, says: str
) -> None:
    log_damage.cache_clear()
    bag = bag_of(tmp_path / 'one', absent=which)
    records = observed(bag, setup_with())
    assert [record.refusal for record in records] == [''] * 10
    assert used(records) == {'' if which == 'other' else 'other': 10}
    (warning,) = caplog.messages
    assert says in warning


@pytest.mark.parametrize(
    ('others', 'says'),
    [
        ({'more_alignments': [0.0]}, 'more_alignments: 1 numbers, but 1 further .* need 4'),
        ({'more_alignments': [1.0, 1.0, 0.0, 0.0]}, 'more_alignments: .* is not a unit'),
        ({'more_star_trackers': ['a b']}, "more_star_trackers: 'a b' is not a valid frame name"),
        (
            {'more_star_trackers': ['a', 'a'], 'more_alignments': 8 * [0.0]},
            "more_star_trackers: 'a' is given twice",
        ),
        # As star_tracker_frame and camera_frame, whose attitudes and transforms they would be.
        (
            {'more_star_trackers': ['/star_tracker']},
            "'/star_tracker' is given twice: .* different names",
        ),
        ({'more_star_trackers': ['camera'], 'camera_frame': '/camera'}, "'camera' is given twice"),
        ({'prior_alignment': 4 * [0.0]}, 'more_alignments needs prior_alignment'),
    ],
)
def test_options_that_do_not_go_together(others: dict[str, object], says: str) -> None:
    with pytest.raises(OptionError, match=says):
        setup_with(**others)
