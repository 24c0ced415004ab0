# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A mistake of the set-up is named with its remedy by `calibrate` and `diagnose`, and no other."""

from collections.abc import Callable, Sequence
import dataclasses
import json
from pathlib import Path
import re
from typing import Any

from mission_files import attitudes, images, params_with, TINY, write_compressed, write_encoded  # type: ignore[import-not-found]
import numpy as np
import pytest
from starcal_tool import assert_refused, Starcal  # type: ignore[import-not-found]

from starcal_ground.bag_writer import BagWriter
from starcal_ground.mission.ingest.deep_catalog import write_deep_catalog
from starcal_ground.simulation import simulated_bag
from starcal_ground.simulation.scenario import scenario
from starcal_ground.simulation.simulated_bag import ATTITUDE_TOPIC, IMAGE_TOPIC
from starcal_ros.records import Image

IMAGES = 4
REAL_SKY = Path(__file__).parents[5] / 'shared' / 'realsky'

Write = Callable[[BagWriter, Image], None]


def _as(encoding: str, pixels: Callable[[Any], Any]) -> Write:
    """Write an image in an encoding that is not read."""
    return lambda writer, image: write_encoded(
        writer, IMAGE_TOPIC, image, encoding, pixels(image.pixels)
    )


def _bmp(writer: BagWriter, image: Image) -> None:
    write_compressed(writer, IMAGE_TOPIC, image, 'bmp', (image.pixels >> 4).astype(np.uint8))


def _raw(writer: BagWriter, image: Image) -> None:
    writer.write_image(IMAGE_TOPIC, image, 'camera')


def _rows_lost(writer: BagWriter, image: Image) -> None:
    pixels = image.pixels.copy()
    pixels[:80] = 0
    writer.write_image(IMAGE_TOPIC, Image(image.time_ns, pixels), 'camera')


def _of_pixels(change: Callable[[Any], Any]) -> Write:
    """Write an image of another size than the camera file states."""
    return lambda writer, image: _raw(
        writer, Image(image.time_ns, np.ascontiguousarray(change(image.pixels)))
    )


def bag(path: Path, write: Write, shift_s: float = 0.0, cut: int | None = None) -> Path:
    """Write the tiny bag with images written in another way, and shifted attitudes."""
    with BagWriter(path) as writer:
        for time_ns, xyzw in attitudes()[:cut]:
            shifted_ns = time_ns + round(shift_s * 1e9)
            writer.write_attitude(ATTITUDE_TOPIC, shifted_ns, xyzw, 'icrf')
        for image in images()[:IMAGES]:
            write(writer, image)
    return path


def said(
    starcal: Starcal,
    tmp_path: Path,
    path: Path,
    parameters: Path,
    commands: Sequence[str] = ('calibrate', 'diagnose'),
) -> dict[str, str]:
    """Return what each command says of a bag; checks that it is one line and no success."""
    more = {'calibrate': ['-o', str(tmp_path / 'out'), '--no-report']}
    found = {}
    for command in commands:
        answer = starcal(command, path, '--params', parameters, *more.get(command, ['--json']))
        if answer.status == 3:
            content = json.loads(answer.out)
            found[command] = ' '.join([content['sentence'], *content['mend']])
        else:
            assert_refused(answer)
            found[command] = answer.err
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ('write', 'shift_s', 'words'),
    [
        (_as('rgb8', lambda p: np.repeat((p >> 4).astype(np.uint8)[..., None], 3, 2)), 0.0,
         ['rgb8 is a colour image: set image_channel']),
        (_as('32FC1', lambda p: p.astype(np.float32)), 0.0, ["'32FC1'", '8 or 16 bit']),
        (_bmp, 0.0, ['is not a PNG or JPEG', 'raw, as PNG or JPEG']),
        (_raw, 18000.0, ['18000.0', 'stamp_offset_s: 18000.0']),
        (_raw, -946727935.0, ['stamp_offset_s: -946727934', 'the date of the attitudes']),
        (_rows_lost, 0.0, ['incomplete', 'constant', 'max_lost_fraction']),
        # No refusal of the size hides what the stars show of it.
        (_of_pixels(lambda p: p[50:450, 60:600]), 0.0, ['a region of the detector', '- x_offset']),
        (_of_pixels(lambda p: p[::2, ::2]), 0.0, ['binned 2 x 2', 'fx, fy, cx, cy = 900.']),
    ],
)  # fmt: skip
def test_a_mistake_of_the_bag(write, shift_s, words, tmp_path, starcal) -> None:
    path = bag(tmp_path / 'bag.mcap', write, shift_s)
    for text in said(starcal, tmp_path, path, params_with(tmp_path)).values():
        for word in words:
            assert word.lower() in text.lower(), text


@pytest.mark.slow
def test_clocks_that_cannot_be_matched_are_two_clocks(tmp_path, starcal) -> None:
    """With the attitudes of one image only no shift can be found."""
    path = bag(tmp_path / 'bag.mcap', _raw, 7200.0, cut=4)
    for text in said(starcal, tmp_path, path, params_with(tmp_path)).values():
        assert 'two clocks' in text and '2026-05-15 09:19:59.250 UTC' in text
        assert 'stamp_offset_s' in text


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'star_tracker_sigma_arcsec': [4.8e-5, 4.8e-5, 2e-4]}, ['radians', '[9.9, 9.9, 41.3]']),
        ({'star_tracker_sigma_arcsec': [0.003, 0.003, 0.009]}, ['degrees', '[10.8, 10.8, 32.4]']),
        ({'magnitude_limit': 2.0}, ['magnitude_limit: 2 leaves', 'raise it']),
    ],
)
def test_a_mistake_of_the_parameters(changes, words, tmp_path, starcal) -> None:
    for text in said(starcal, tmp_path, TINY, params_with(tmp_path, **changes)).values():
        for word in words:
            assert word in text


def test_an_uncertainty_of_the_mounting_that_is_too_small(tmp_path, starcal) -> None:
    """A field of half a degree, off by another one, and stated to be known to 0.01 degrees."""
    given = dataclasses.replace(scenario('narrow'), image_count=3)
    mistakes = simulated_bag.Mistakes(alignment_error_deg=0.5)
    made = simulated_bag.write_bag(given, tmp_path / 'bag', mistakes=mistakes)
    write_deep_catalog(tmp_path / 'bag' / 'gaia.csv', tmp_path / 'bag' / 'gaia.npz')
    text = made.params.read_text()
    made.params.write_text(re.sub(r'(alignment_sigma_deg): .*', r'\1: 0.01', text))
    found = said(starcal, tmp_path, made.bag, made.params, ['calibrate'])['calibrate']
    assert re.search(r'points 0\.[45]\d+ degrees away .* prior_alignment_sigma_deg: 0\.01', found)
    assert 'Set prior_alignment: [' in found


def test_the_remedy_is_named_without_parameters(tmp_path, starcal) -> None:
    path = bag(tmp_path / 'bag.mcap', _bmp)
    status, out, _ = starcal('diagnose', path)
    assert status == 3
    assert 'is not a PNG or JPEG' in out.partition('Cannot be calibrated')[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    'given',
    [
        lambda few, folder: [few, '--params', params_with(folder)],
        # More images than there are, or than most cameras take: a sound set that is refused.
        lambda few, folder: [few, '--params', params_with(folder, min_images=4)],
        lambda few, folder: [few, '--params', params_with(folder, min_coverage=1.0)],
        lambda few, _: [few, '--set', 'min_images=4'],
        lambda *_: [REAL_SKY / 'polaris'],
    ],
)
def test_it_says_that_all_fits_only_of_what_calibrate_accepts(
    given, few_images, tmp_path, starcal
) -> None:
    arguments = given(few_images, tmp_path)
    if not Path(arguments[0]).exists():
        pytest.skip('the real sky is not here')
    status, out, _ = starcal('diagnose', *arguments, '--json')
    found = json.loads(out)
    answer = starcal('calibrate', *arguments, '-o', tmp_path / 'out', '--no-report')
    assert (status == 0) == (answer.status == 0), answer.err
    assert (found['cause'] == 'none') == (status == 0)
    if answer.status:
        assert found['cause'] in ('refused', 'not_linear')
        assert found['cause'] != 'refused' or 'but starcal calibrate refuses' in found['sentence']


@pytest.mark.slow
@pytest.mark.parametrize(
    ('options', 'cause'),
    [
        (['--flip'], 'mirrored'),
        (['--rotate', '90'], 'rotated'),
        (['--attitude-direction', 'inertial_to_st'], 'attitude_direction'),
        (['--quaternion-order', 'wxyz'], 'quaternion_order'),
        (['--alignment-error', '10'], 'prior_alignment'),
        (['--focal-error', '20'], 'focal_length'),
        (['--clock-error', '8'], 'clock'),
        (['--smear', '12'], 'smear'),
        (['--gamma', '2.2'], 'not_linear'),
    ],
)
def test_a_simulated_mistake_is_named(options, cause, tmp_path, starcal) -> None:
    bag = tmp_path / 'bag'
    made = starcal('simulate', '-o', bag, '--scenario', 'tiny', '--images', 3, *options)
    assert made.status == 0 and 'truth.json' in made.out and 'params.yaml' in made.out
    assert json.loads((bag / 'truth.json').read_text())['images'] == 3
    status, out, _ = starcal('diagnose', bag, '--params', bag / 'params.yaml', '--json')
    found = json.loads(out)
    assert (found['cause'], found['also']) == (cause, [])
    assert status == 3


def test_no_simulated_mistake_changes_nothing() -> None:
    shown: Image = images()[0]
    same = simulated_bag.NO_MISTAKES.image(shown)
    assert same.time_ns == shown.time_ns and (same.pixels == shown.pixels).all()
    late = simulated_bag.Mistakes(clock_error_s=2.5).image(shown)
    assert late.time_ns - shown.time_ns == 2_500_000_000
