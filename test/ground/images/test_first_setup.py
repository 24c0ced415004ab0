# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal calibrate` of whatever is given: found, assumed, stated; wrong inputs in one line."""

import json
from pathlib import Path
import re

from mission_files import attitudes, frames_of, images, TINY, write_pngs, write_tiny  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from starcal_tool import assert_refused  # type: ignore[import-not-found]

from starcal_ground.parameter_files import read_setup
from starcal_ros.formats.products.product_files import read_calibration

TRUTH = json.loads((TINY / 'truth.json').read_text())
ATTITUDES = '/star_tracker/attitude'
ALIGNMENT_DEG = 0.1  # noise of the star tracker in the bag: 0.011; a prior must be within 1.5
COLUMNS = 80
LENS = ('--focal-length-mm', '18', '--pixel-size-um', '10')  # of this camera, within 1 %


def with_attitudes(path: Path, count: int, sign: int = 1, shift_s: int = 0) -> Path:
    """Images with attitudes that are late, or inverted (-1): from ICRF to the star tracker."""
    samples = ((ns + shift_s * 10**9, q * [sign, sign, sign, 1]) for ns, q in attitudes())
    write_tiny(path, images()[:count], samples)
    return path


@pytest.mark.slow
@pytest.mark.parametrize('direction', ['st_to_inertial', 'inertial_to_st'])
def test_a_bag_of_which_nothing_is_stated(tmp_path, direction, starcal, monkeypatch) -> None:
    monkeypatch.setenv('COLUMNS', str(COLUMNS))
    is_plain = direction == 'st_to_inertial'
    bag = TINY if is_plain else with_attitudes(tmp_path / 'b.mcap', 10, -1)
    monkeypatch.chdir(tmp_path)
    out = Path('out')
    status, text, notes = starcal('calibrate', bag, '-o', out)
    assert status == 0
    assert f'attitudes of {ATTITUDES}: {direction}, 8 images agree' in notes
    assert 'images identified by their stars: focal length 1801.' in notes
    assert 'star_tracker_sigma_arcsec: assumed from the scatter of the images' in text
    joined = ' '.join(text.split())
    # What lowers a sigma most, by how much.
    ((before, after),) = re.findall(r'noise; pointing \(rms\) (.*?)″ becomes (.*?)″ if', joined)
    assert float(after) < float(before)
    assert 'lens model plumb_bob, 640 x 512 px' in text
    *_, last = text.split('\n\n')
    assert last.startswith('accepted by the gate\n') and 'Next: ' in last
    assert '"' not in text and ' arcsec' not in text  # one sign
    assert 'from prior' not in text  # a first solution of the same images
    assert 'id="figure-change"' not in (out / 'report.html').read_text()
    assert max(map(len, text.splitlines())) <= COLUMNS
    setup = read_setup(out / 'params.yaml')
    assert setup.attitude.attitude_direction == direction
    aligned = Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw)
    off = aligned * Rotation.from_matrix(TRUTH['A_true'])
    assert np.degrees(off.magnitude()) < ALIGNMENT_DEG
    # Five sigma of a fit to the brightest stars with 0.3 px each: 1801 px to 0.1 %.
    assert setup.prior.camera.parameters[0] == pytest.approx(TRUTH['k_true'][0], rel=1e-3)
    assert ('observer' in (out / 'params.yaml').read_text()) is not is_plain  # it has velocities
    first = read_calibration(out / 'calibration.json')
    # Ten images give a sigma to 24 %; truth is 10, 10 and 40 arcsec about axes that stars show to
    # some arcseconds.
    assert (np.array([4, 4, 15]) < first.star_tracker_sigma_arcsec).all()
    assert (first.star_tracker_sigma_arcsec < np.array([25, 25, 80])).all()

    # The files repeat the calibration.
    again = tmp_path / 'again'
    given = ['--params', out / 'params.yaml', '-o', again, '--no-report']
    assert starcal('calibrate', bag, *given, '--quiet') == (0, '', '')
    second = read_calibration(again / 'calibration.json')
    np.testing.assert_allclose(
        second.geometry.camera.parameters, first.geometry.camera.parameters, rtol=1e-6, atol=1e-6
    )
    assert not (again / 'params.yaml').exists()


@pytest.mark.slow
def test_attitudes_that_do_not_fit_are_diagnosed(tmp_path, starcal) -> None:
    bag = with_attitudes(tmp_path / 'b.mcap', 4, shift_s=5)
    assert_refused(
        starcal('calibrate', bag, *LENS, '-o', tmp_path / 'out', '--quiet'),
        'prior_alignment: not given, and not found: The stamps of the images',
        'Set stamp_offset_s: ',
        '(details: starcal diagnose); look at ',
    )
    status, out, _ = starcal('diagnose', bag, *LENS)
    assert status == 3 and 'in the parameter file:\n  stamp_offset_s: ' in out


@pytest.mark.slow
def test_streaks_that_are_measured_are_identified_too(tmp_path, starcal) -> None:
    """Twice as long as wide, but their middles make the patterns of points."""
    bag, out = tmp_path / 'bag', tmp_path / 'out'
    line = ['simulate', '-o', bag, '--scenario', 'tiny', '--smear', 8, '--images', 3]
    assert starcal(*line).status == 0
    status, _, notes = starcal('calibrate', bag, *LENS, '-o', out, '--no-report')
    assert status == 0 and '3 of 3 images identified by their stars' in notes
    calibration = read_calibration(out / 'calibration.json')
    truth = json.loads((bag / 'truth.json').read_text())['k_true'][0]
    # One draw: 4 sigma are exceeded once in 16,000.
    assert abs(calibration.geometry.camera.parameters[0] - truth) < 4 * calibration.sigma[0]


@pytest.mark.slow
def test_photographs_of_which_nothing_is_stated(tmp_path, starcal) -> None:
    night, out = write_pngs(tmp_path / 'night', frames_of(3)), tmp_path / 'out'
    stated = ['--focal-length-mm', 50, '--pixel-size-um', 10]
    status, text, notes = starcal('calibrate', night, '-o', out, '--no-report', *stated)
    assert status in (0, 3)
    assert 'px (stated: 5000 px, which the stars contradict)' in notes
    assert 'observer: assumed by the stars' in text and 'star_tracker' not in text
    assert '# observer: by the stars' in (out / 'params.yaml').read_text()
    status, text, _ = starcal('diagnose', night, *LENS)
    assert status == 0
    assert 'the camera alone can be calibrated' in text and '3 of 3 images' in text


@pytest.mark.slow
def test_a_bag_on_the_ground_without_a_site_shows_its_air_by_its_stars(
    tiny_products, tmp_path, starcal
) -> None:
    """A bag in space: its stars contradict the ground, and the sigma holds half of the air."""
    observed = tiny_products / 'observations.mcap'
    given = ['--params', TINY / 'params.yaml', '--set', 'observer=ground']
    for command in (['diagnose', TINY], ['calibrate', observed, '-o', tmp_path, '--no-report']):
        status, _, notes = starcal(*command, *given)
        assert status == 0 and 'observer: ground: the stars do not show its air' in notes
    calibration = read_calibration(tmp_path / 'calibration.json')
    truth = TRUTH['k_true'][0]
    focal_px, sigma_px = calibration.geometry.camera.parameters[0], calibration.sigma[0]
    # Half of 52 arcsec is 1.3e-4 of the focal length; one draw, as above.
    assert abs(focal_px - truth) < 4 * sigma_px < 4 * 1.5e-4 * focal_px


@pytest.mark.slow
def test_a_requirement_is_answered_in_json(tiny_products, tmp_path, starcal) -> None:
    observations = tiny_products / 'observations.mcap'
    command = ['calibrate', observations, '--params', TINY / 'params.yaml', '-o', tmp_path]
    command += ['--no-report', '--json', '--set', 'star_tracker_slow_arcsec=5']
    status, out, _ = starcal(*command, '--require', 'line_of_sight=20arcsec@98%')
    answer = json.loads(out)
    assert status == 0
    assert answer['accepted'] and [row['note'] for row in answer['requirements']] == ['met']
    assert answer['lens_model'] == 'plumb_bob' and answer['folder'] == str(tmp_path)
    assert answer['assumed'].keys() == {'stamp_offset_s'}
    # Now it is 1.1 of this.
    status, out, _ = starcal(*command, '--require', 'f=0.055px')
    answer = json.loads(out)
    assert status == 3
    (check,) = answer['requirements']
    words = r'missed by 0.00\d+ px; \d+ more images? reach(es)? it'
    assert re.match(words, check['note']) and check['found'] < 0.07
    (reason,) = answer['reasons']
    assert reason.endswith(f'over the limit of 0.055 px (requirements); {check["note"]}')
