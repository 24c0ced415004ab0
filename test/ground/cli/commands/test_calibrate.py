# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal calibrate` where it fails, where little is given, and on parts of a bag."""

import dataclasses
import json
import re
import shutil

from mission_files import params_with, TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from sample_records import calibration, without_field  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation
from starcal_tool import assert_refused  # type: ignore[import-not-found]
import yaml

from starcal_ground.bags.reader import read_observations
from starcal_ground.cli.commands.calibrate import print_calibration
from starcal_ground.products import (
    NOT_CALIBRATED_FILE,
    OBSERVATIONS_FILE,
    OBSERVATIONS_TOPIC,
    write_observations,
)
from starcal_ground.written_files import write_marked
from starcal_ros.camera.projection import convert
from starcal_ros.records import FOUND, refused_image, SigmaPart


@pytest.mark.slow
def test_a_failure_replaces_older_products(few_images, tiny_products, tmp_path, starcal) -> None:
    out = tmp_path / 'out'
    shutil.copytree(tiny_products, out)
    assert 'Accepted' in (out / 'report.html').read_text()
    params = params_with(tmp_path, attitude_direction='inertial_to_st')
    answer = starcal('calibrate', few_images, '--params', params, '-o', out)
    assert_refused(answer, 'Set attitude_direction: st_to_inertial. (details: starcal diagnose)')
    assert answer.err.endswith(f'; look at {out}/report.html\n')
    record = json.loads((out / NOT_CALIBRATED_FILE).read_text())
    assert (record['calibrated'], record['cause']) == (False, 'attitude_direction')
    assert (record['images_used'], record['images_refused']) == (0, {'no_match': 3})
    assert record['mend'] == ['attitude_direction: st_to_inertial']
    for name in ('calibration.json', 'camera_info.yaml', 'residuals.npz'):
        assert not (out / name).exists()
    for is_made_again in (False, True):  # as calibrate left it, and by report
        assert not is_made_again or starcal('report', out).status == 0
        page = (out / 'report.html').read_text()
        assert 'Not calibrated' in page and 'Accepted' not in page
        assert page.count('<figure><img src="data:image/png;base64,') == 3
        assert 'attitude_direction: st_to_inertial' in page
        assert 'Images: 0 used, refused: 3 no_match' in page
    sound = few_images / 'params.yaml'
    assert starcal('calibrate', few_images, '--params', sound, '-o', out).status == 0
    assert not (out / NOT_CALIBRATED_FILE).exists()
    assert 'Accepted' in (out / 'report.html').read_text()


@pytest.mark.slow
def test_a_failure_for_want_of_images_has_the_counts_of_a_calibration(
    few_images, tmp_path, starcal
) -> None:
    command = ['calibrate', few_images, '--params', few_images / 'params.yaml', '-o', tmp_path]
    answer = starcal(*command, '--set', 'min_images=20')
    record = json.loads((tmp_path / NOT_CALIBRATED_FILE).read_text())
    images, stars = record['images_used'], record['stars_used']
    assert images == 3 and stars > 100 and record['stars_refused']
    assert '(3 of 20 collected)' in answer.err
    assert f'(images: {images} used, refused: none; stars: {stars} used, refused: ' in answer.err
    page = (tmp_path / 'report.html').read_text()
    assert f'<p>Stars: {stars} used, refused: ' in page


@pytest.mark.slow
def test_the_reason_of_each_refusal_is_said(tiny_products, tmp_path, starcal) -> None:
    images = list(read_observations([tiny_products / OBSERVATIONS_FILE], OBSERVATIONS_TOPIC))
    one, two, *others = images
    refused = [
        refused_image(image.time_ns, image.width, image.height, 'no_match', 'in one part only')
        for image in (one, two)
    ]
    (tmp_path / 'bag').mkdir()
    write_observations([*refused, *others], tmp_path / 'bag', 'camera')
    command = ['calibrate', tmp_path / 'bag', '--params', TINY / 'params.yaml']
    said = starcal(*command, '-o', tmp_path / 'out', '--no-report').err
    words = '2 of 10 images refused, no_match: no rotation of the predicted stars explains'
    assert words in said and '(in one part only)' in said


def broken(*_: object) -> None:
    raise TypeError('another version')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('place', 'missing'),
    [
        ('starcal_ground.report.page.page_template', 'report'),
        ('starcal_ground.report.thumbnails.annotate_reduced', 'pictures of images'),
    ],
)
def test_a_drawing_that_fails_costs_the_drawing_only(
    few_images, tmp_path, starcal, monkeypatch, place, missing
) -> None:
    out = tmp_path / 'out'
    out.mkdir()
    write_marked(out / 'report.html', 'of earlier products')
    monkeypatch.setattr(place, broken)
    said = starcal('calibrate', few_images, '--params', few_images / 'params.yaml', '-o', out)
    assert said.status == 0 and 'accepted by the gate' in said.out
    assert f'warning: no {missing}, ' in said.err and 'TypeError: another version' in said.err
    assert said.err.count('\n') == 1
    assert ('the products cannot be drawn' in said.err) == (missing == 'report')
    assert (out / 'report.html').exists() == (missing != 'report')
    assert json.loads((out / 'calibration.json').read_text())['accepted']


@pytest.mark.slow
def test_a_page_that_fails_hides_no_failure(few_images, tmp_path, starcal, monkeypatch) -> None:
    monkeypatch.setattr('starcal_ground.report.page.write_failure_page', broken)
    monkeypatch.setattr('starcal_ground.report.thumbnails._expected_picture', broken)
    params = params_with(tmp_path, attitude_direction='inertial_to_st')
    out = tmp_path / 'out'
    answer = starcal('calibrate', few_images, '--params', params, '-o', out)
    words = answer.err.splitlines()
    assert answer.status == 2
    assert len(words) == 3 and 'no pictures of images' in words[0] and 'no report' in words[1]
    assert 'Set attitude_direction: st_to_inertial.' in words[2]
    assert (out / NOT_CALIBRATED_FILE).exists() and not (out / 'report.html').exists()


@pytest.mark.slow
def test_alignment_and_tracker_sigma_are_found_and_said(few_images, tmp_path, starcal) -> None:
    params = params_with(tmp_path, prior_alignment=None, star_tracker_sigma_arcsec=None)
    out = tmp_path / 'out'
    said = starcal('calibrate', few_images, '--params', params, '-o', out, '--no-report')
    assert 'prior_alignment is not given: found [' in said.err
    assert 'star_tracker_sigma_arcsec: assumed from the scatter of the images' in said.out
    camera = yaml.safe_load((out / 'camera_info.yaml').read_text())
    prior = yaml.safe_load((TINY / 'camera.yaml').read_text())
    assert camera['camera_name'] == prior['camera_name'] != 'camera'


@pytest.mark.parametrize('rate', [0.0, np.nan])
def test_rates_that_no_image_has_are_said(rate, tmp_path, tiny_products, starcal) -> None:
    recorded = read_observations([tiny_products / OBSERVATIONS_FILE], OBSERVATIONS_TOPIC)
    rates = np.full(3, rate)
    images = [dataclasses.replace(image, star_tracker_rate_rad_s=rates) for image in recorded]
    write_observations(images, tmp_path, 'camera')
    bag, params = tmp_path / OBSERVATIONS_FILE, params_with(tmp_path, shutter=None)
    given = ['--params', params, '-o', tmp_path / 'out', '--no-report']
    said = starcal('calibrate', bag, *given).words
    assert ('the turn of a low orbit in the sigma' in said) == np.isnan(rate)
    assert 'read out within 20 ms' in said


def test_a_part_of_a_bag(tiny_products, tmp_path, starcal) -> None:
    given = ['--params', TINY / 'params.yaml', '-o', tmp_path / 'out', '--no-report']
    said = starcal('calibrate', tiny_products / OBSERVATIONS_FILE, *given, '--to', '+20').out
    assert 'images      6 used' in said  # six may be too few for the gate


def test_the_causes_that_matter_follow_the_result(capsys) -> None:
    budget = (
        *calibration().sigma_budget,
        SigmaPart('stamps', 0.14, 0.02, '5 ms assumed'),  # a fifth of all
        SigmaPart('star tracker noise', 0.0, 12.0, 'estimated: 20, 20, 20″ about x, y, z'),
    )
    record = dataclasses.replace(calibration(), sigma_budget=budget)
    print_calibration(record, record.geometry)
    lines = capsys.readouterr().out.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith('1-sigma of lines'))
    assert [line.split('  ')[0] for line in lines[first + 1 : first + 4]] == [
        'total', 'star tracker noise', 'velocity'
    ]  # fmt: skip
    assert lines[first + 3].split() == ['velocity', '0.6″', '0.75″']
    assert 'stamps' not in '\n'.join(lines) and max(map(len, lines)) <= 80
    print_calibration(dataclasses.replace(record, sigma_budget=()), record.geometry)
    assert '1-sigma of lines' not in capsys.readouterr().out


def test_an_alignment_that_the_images_gave_is_not_compared_with_itself(capsys) -> None:
    record = calibration()
    moved = record.geometry.star_tracker_from_camera * Rotation.from_rotvec([1e-4, 0.0, 0.0])
    prior = dataclasses.replace(record.geometry, star_tracker_from_camera_xyzw=moved.as_quat())
    rows = []
    for provenance in ({}, {FOUND: 'alignment'}):
        print_calibration(dataclasses.replace(record, provenance=provenance), prior)
        (row,) = re.findall('^alignment x .*$', capsys.readouterr().out, re.MULTILINE)
        rows.append(row.split())
    assert len(rows[0]) == 6 and rows[1] == rows[0][:4]


def test_a_lens_that_the_prior_did_not_have_has_no_changes(capsys) -> None:
    """With ``lens_model: auto``."""
    prior = calibration().geometry
    camera, _ = convert(prior.camera, 'rational_polynomial')
    record = dataclasses.replace(
        without_field(),
        geometry=dataclasses.replace(prior, camera=camera),
        covariance=np.eye(len(camera.parameters) + 3),
    )
    print_calibration(record, prior)
    said = capsys.readouterr().out
    assert re.search(r'^k6 +\S+ +held, \S+ *$', said, re.MULTILINE)
    print_calibration(dataclasses.replace(record, parent_frame=''), prior)  # no alignment either
    assert 'from prior' in said and 'from prior' not in capsys.readouterr().out
