# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Every program that reads a bag calibrates by one recipe; for the nodes see `test/nodes`."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
import json
from pathlib import Path
import shutil
from typing import Any

import cv2
from mission_files import images, params_with, TINY, write_tiny  # type: ignore[import-not-found]
import numpy as np
import pytest
from starcal_tool import Starcal  # type: ignore[import-not-found]

import starcal_ground
from starcal_ground import campaign
from starcal_ground.bags.reader import read_observations, Topics
from starcal_ground.cli.main import main
from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.fleet import Cameras
from starcal_ground.parameter_files import read_setup
from starcal_ros.records import Calibration, refused_image

pytestmark = pytest.mark.slow

UNSOUND = ('--seed', '7', '--images', '6', '--alignment-error', '1.0', '--focal-error', '6')
"""A bag of the scenario tiny, of whose images two match only with the calibration of the rest."""


def unaligned(folder: Path, few_images: Path) -> Path:
    bag = Path(shutil.copytree(few_images, folder / 'bag'))
    params_with(bag, prior_alignment=None)
    return bag


def unsited(folder: Path, _: Path) -> Path:
    """A bag whose set-up is wrong, and on the ground, where the stars are to show the air."""
    bag = folder / 'bag'
    assert main(['simulate', '--scenario', 'tiny', *UNSOUND, '-o', str(bag)]) == 0
    with (bag / 'params.yaml').open('a') as params:
        params.write('\n    observer: ground\n')
    return bag


BAGS = [unaligned, unsited]


@pytest.fixture(scope='module', params=BAGS, ids=[make.__name__ for make in BAGS])
def bag(request, tmp_path_factory: pytest.TempPathFactory, few_images: Path) -> Path:
    make: Callable[[Path, Path], Path] = request.param
    return make(tmp_path_factory.mktemp(make.__name__), few_images)


@pytest.fixture(scope='module')
def expected(bag: Path) -> Calibration:
    """The calibration of `starcal calibrate`, from all images."""
    out = bag.parent / 'out'
    params = str(bag / 'params.yaml')
    assert main(['calibrate', str(bag), '--params', params, '-o', str(out)]) == 0
    written = starcal_ground.read_calibration(out)
    assert written.accepted and written.images_used == (6 if 'unsited' in str(bag) else 3)
    return written


def by_python(bag: Path) -> Mapping[str, Any]:
    return numbers_of(starcal_ground.calibrate_bag(bag, bag / 'params.yaml'))


def by_trend(bag: Path) -> Mapping[str, Any]:
    (task,) = fleet.find(str(bag), Cameras(params=str(bag / 'params.yaml')))
    row = fleet.compute(task)
    assert row.calibration is not None, row.error
    return numbers_of(row.calibration)


def by_plan(bag: Path, starcal: Starcal) -> Mapping[str, Any]:
    """The sigma from which a plan starts, whatever pointings it chooses from."""
    pointings = bag.parent / 'pointings.csv'
    pointings.write_text('ra_deg,dec_deg\n1,2\n')
    wanted = ['--images', '1', '--minimise', 'fx', '--json', '--pointings', pointings]
    answer = starcal('plan', bag, '--params', bag / 'params.yaml', *wanted)
    return {'sigma of fx': json.loads(answer.out)['sigma']}


def numbers_of(calibration: Calibration) -> Mapping[str, Any]:
    values, images = calibration.geometry.camera.parameters, calibration.images_used
    sigma = calibration.sigma[calibration.parameter_names.index('fx')]
    return {'images': images, 'values': values, 'sigma of fx': sigma}


@pytest.mark.parametrize('entrance', [by_python, by_trend, by_plan])
def test_all_entrances_give_one_calibration(bag, expected, entrance, starcal) -> None:
    given = (bag, starcal) if entrance is by_plan else (bag,)
    for name, number in entrance(*given).items():
        # JSON and Parquet keep all digits; the process has solved it with one BLAS thread.
        np.testing.assert_allclose(number, numbers_of(expected)[name], rtol=1e-9, err_msg=name)


def test_images_measured_again_have_the_air_of_all_and_pictures(bag, expected) -> None:
    observed = read_observations([bag.parent / 'out' / 'observations.mcap'], '/observations')
    is_known = [bool(np.isfinite(one.zenith_icrf).all()) for one in observed]
    is_unsited = 'observer: ground' in (bag / 'params.yaml').read_text()
    assert is_known == [is_unsited] * expected.images_used
    # Their pictures show the stars found then.
    pictures = sorted((bag.parent / 'out' / 'thumbnails').iterdir())
    assert len(pictures) == expected.images_used
    for path in pictures:
        blue, green, red = np.moveaxis(np.asarray(cv2.imread(str(path)), int), 2, 0)
        # Circles about the measured stars, as the encoding leaves them.
        assert np.count_nonzero(green - np.maximum(blue, red) > 60) > 20, path.name


def observed_with(bag: Path, params: Path = TINY / 'params.yaml') -> campaign.Observed:
    source = campaign.Source((bag,), Topics(), read_setup(params))
    return campaign.observe(campaign.chosen(source))


def test_images_without_a_match_are_measured_with_the_calibration(tmp_path) -> None:
    """No other image is."""
    observed = observed_with(write_tiny(tmp_path / 'bag.mcap', images()[:7]))
    source, seen = observed.source, observed.measured
    lost, smeared = (
        refused_image(seen[k].time_ns, seen[k].width, seen[k].height, reason, reason)
        for k, reason in ((2, 'no_match'), (5, 'no_stars'))
    )
    before = [*seen[:2], lost, *seen[3:5], smeared, *seen[6:]]
    done: list[int] = []

    @contextlib.contextmanager
    def progress(total: int) -> Iterator[Callable[[], None]]:
        yield lambda: done.append(total)

    made = campaign.calibrate(campaign.Observed(source, before, tuple(before), ()), None, progress)
    assert done == [1]
    again = made.observations
    assert made.notes[0].startswith('1 image') and made.calibration.images_used == 6
    assert all(a is b for k, (a, b) in enumerate(zip(again, before, strict=True)) if k != 2)
    # The same stars at the same places, by a search in place of a track.
    common = np.isin(again[2].catalog_id, seen[2].catalog_id)
    assert common.sum() > 0.95 * len(seen[2])


def test_of_two_images_of_one_stamp_each_is_measured_again_for_itself(tmp_path) -> None:
    """Neither matched at first; now the first one does, and the other is out of order."""
    observed = observed_with(write_tiny(tmp_path / 'bag', (*images()[:3], *images()[2:6])))
    before = list(observed.measured)
    for k in (2, 3):
        one = before[k]
        before[k] = refused_image(one.time_ns, one.width, one.height, 'no_match', '')
    made = campaign.calibrate(campaign.Observed(observed.source, before, tuple(before), ()))
    assert made.notes[0].startswith('1 image') and made.calibration.images_used == 6
    assert not made.observations[2].refusal and made.observations[3] is before[3]


def test_a_calibration_refused_for_want_of_stars_finds_those_of_a_right_prior(tmp_path) -> None:
    """A prior off by 20 px in the corners leads to 7 % fewer stars, and misses a requirement."""
    bag = Path(shutil.copytree(TINY, tmp_path / 'bag'))
    with (bag / 'params.yaml').open('a') as params:
        params.write("    magnitude_limit: 5.0\n    requirements: ['map=0.038px']\n")
    expected = campaign.calibrate(observed_with(bag, bag / 'params.yaml'))
    camera = bag / 'camera.yaml'
    camera.write_text(camera.read_text().replace('data: [-0.045, 0.08,', 'data: [1.0, 0.0,'))
    found = campaign.calibrate(observed_with(bag, bag / 'params.yaml'))
    assert found.notes == ('the calibration lacked stars at first: 14 more are found with it',)
    assert found.calibration.accepted and not expected.notes
    assert found.calibration.stars_used == expected.calibration.stars_used
    # The stars are measured again from other predictions: the sigma of fx is 0.3 px.
    offset = found.calibration.geometry.camera.parameters[0]
    offset -= expected.calibration.geometry.camera.parameters[0]
    assert abs(offset) < 0.03


def test_a_diagnosis_reads_as_a_calibration(bag, expected, starcal) -> None:
    """Before the images that matched nothing are measured again."""
    shown = json.loads(starcal('diagnose', bag, '--params', bag / 'params.yaml', '--json').out)
    contents = shown['contents']
    unmatched = {group['reason']: group['count'] for group in contents['refused']}
    assert set(unmatched) <= {'no_match'}
    assert len(contents['stars_per_image']) + sum(unmatched.values()) == expected.images_used
    assert (shown['cause'] == 'prior_alignment') == (not unmatched)


@pytest.mark.parametrize(
    ('arguments', 'problem'),
    [
        (('--image-topic', '/star_tracker/attitude'), 'no topic /star_tracker/attitude of type'),
        (('--attitude-topic', 'other'), 'no topic other of type'),
        (('--observations-topic', 'other'), 'no topic other of type'),
    ],
)
def test_a_diagnosis_with_a_wrong_topic_lists_all(starcal, arguments, problem) -> None:
    given = ['--params', TINY / 'params.yaml', *arguments]
    status, shown, _ = starcal('diagnose', TINY, *given)
    assert status == 3
    assert '/opnav/image_raw' in shown and problem in shown
