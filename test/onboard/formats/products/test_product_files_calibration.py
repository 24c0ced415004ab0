# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""File calibration.json: round trips, damaged files, errors."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_records import assert_same, calibration, plain_calibration, without_field  # type: ignore[import-not-found]

from starcal_ground.written_files import write_calibration
from starcal_ros.errors import ProductError
from starcal_ros.formats.bag.typestore import make_message, typestore
from starcal_ros.formats.messages.message_codec import CALIBRATION_TYPE
from starcal_ros.formats.messages.record_messages import calibration_to_message
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.records import GateCheck, TemperatureTerms

GATE = (
    GateCheck('residual', 'max_residual_rms_px', 0.1 + 0.2, 1.0, 'px', True),
    GateCheck('solver converged', '', math.nan, math.nan, '', False, 'no_descent'),
    GateCheck('turn', 'max_step_rotation_deg', math.nan, 0.5, 'deg', None, 'none active'),
)


def test_calibration_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    cases: tuple[dict[str, Any], ...] = (
        {},
        {'accepted': False, 'reasons': ('too few stars', 'weak: k3')},
        {'temperature': TemperatureTerms(20.0, note='left out: everything')},
        {'model_checks': dataclasses.replace(calibration().model_checks, held=())},
        {'gate': GATE},
    )
    records = (dataclasses.replace(plain_calibration(), **changes) for changes in cases)
    for record in (calibration(), without_field(), *records):
        write_calibration(record, tmp_path / 'calibration.json')
        assert_same(record, read_calibration(tmp_path / 'calibration.json'))


def test_numbers_that_are_not_finite_are_null_and_come_back_nan(tmp_path: Path) -> None:
    covariance = np.eye(13)
    covariance[3, 3] = np.inf
    path = tmp_path / 'c.json'
    record = dataclasses.replace(calibration(), covariance=covariance, variance_factor=math.nan)
    write_calibration(record, path)
    content = json.loads(path.read_text(), parse_constant=pytest.fail)  # strict JSON
    assert content['covariance'][3][3] is None
    back = read_calibration(path)
    assert math.isnan(back.covariance[3, 3]) and math.isnan(back.variance_factor)


def test_json_has_the_keys_of_the_interface_document(tmp_path: Path) -> None:
    path = tmp_path / 'c.json'
    record = plain_calibration()
    write_calibration(record, path)
    content = json.loads(path.read_text())
    assert content['schema'] == 1
    assert list(content['intrinsics']) == ['fx', 'skew', 'fy', 'cx', 'cy']
    assert list(content['distortion']) == ['k1', 'k2', 'k3', 'p1', 'p2']
    assert (content['alignment']['parent'], content['alignment']['child']) == ('st', 'cam')
    assert len(content['alignment']['quaternion_xyzw']) == 4
    assert tuple(content['parameter_names']) == record.parameter_names
    assert content['alignment_covariance_rad2'] == record.covariance[10:, 10:].tolist()
    assert {
        'method', 'estimated', 'residual_rms_px', 'images_used', 'images_refused', 'stars_used',
        'stars_rejected', 'accepted', 'reasons', 'provenance', 'time_ns', 'variance_factor',
        'alignment_scatter_arcsec', 'zero_skew_cost_px', 'iterations', 'termination',
    } <= set(content)  # fmt: skip
    assert content['image'] == {'width': 1296, 'height': 1024}
    assert content['temperature'] is content['maps'] is content['correlation'] is None
    write_calibration(dataclasses.replace(calibration(), gate=GATE), path)
    content = json.loads(path.read_text())
    assert [check['passed'] for check in content['gate']] == [True, False, None]
    assert list(content['temperature']) == [
        'reference_degc', 'focal_per_degc', 'focal_per_degc_sigma',
        'alignment_rate_rad_per_degc', 'alignment_rate_rad_per_degc_sigma', 'note',
    ]  # fmt: skip


def test_a_row_of_a_grid_is_a_line(tmp_path: Path) -> None:
    path = tmp_path / 'c.json'
    provenance = {'note': 'a [\n 1,\n 2\n ] in a text'}
    written = dataclasses.replace(calibration(), provenance=provenance)
    write_calibration(written, path)
    assert '   [0, 1, 2],\n   [3, 4, 5]\n' in path.read_text()
    assert_same(written, read_calibration(path))


def test_a_covariance_of_a_field_is_its_factor_and_remainder(tmp_path: Path) -> None:
    write_calibration(calibration(), tmp_path / 'c.json')
    found = read_calibration(tmp_path / 'c.json')
    F = np.arange(50.0).reshape(25, 2) / 11
    expected = F @ F.T
    R = np.zeros((12, 12))
    R[np.tril_indices(12)] = np.arange(-10, 68)
    R *= np.arange(1.0, 13.0)[:, None] / 7e4
    expected[13:, 13:] += R @ R.T
    np.testing.assert_allclose(found.map_covariance.matrix, expected, rtol=1e-14)
    assert found.map_covariance.unresolved_px == 0.0625


def test_file_and_message_of_a_calibration_are_small(tiny_products: Path) -> None:
    path = tiny_products / 'calibration.json'
    assert path.stat().st_size < 150_000
    found = read_calibration(path)
    assert found.field is not None and found.sigma_budget
    message = calibration_to_message(found, make_message)
    assert len(bytes(typestore().serialize_cdr(message, CALIBRATION_TYPE))) < 100_000


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        (lambda c: c.update(schema=2), 'schema 2 is not 1'),
        (lambda c: c['intrinsics'].update(fx=-1.0), 'not positive'),
        (lambda c: c['distortion'].update(k1=None), 'distortion.k1: None is not a number'),
        (lambda c: c['covariance'].pop(), 'covariance: 12 x 13 numbers, not 12 x 12'),
        (lambda c: c.update(covariance=[[1.0]]), 'covariance: 1 x 1 numbers, not 13 x 13'),
        (lambda c: c['parameter_names'].pop(), 'parameters: .* is not 10 finite numbers'),
        (lambda c: c['parameter_names'].__setitem__(9, 'p3'), "key 'distortion.p3' is missing"),
        (lambda c: c['image'].update(width=-1), 'image.width: -1 is not within 0 to 4294967295'),
        (lambda c: c['images_refused'].update(blank='x'), "images_refused.blank: 'x' is not a wh"),
        (lambda c: c['alignment'].update(parent=3), 'alignment.parent: 3 is not a text'),
        # Before the field over the detector takes gigabytes.
        (lambda c: c['image'].update(height=2_000_000), 'image size: .* is over 65536 px'),
        (
            lambda c: c['temperature'].update(alignment_rate_rad_per_degc=[1.0]),
            'temperature.alignment_rate_rad_per_degc_sigma: 3 numbers, not 1',
        ),
        (lambda c: c['correlation']['matrix'].pop(), 'correlation.matrix: 1 x 2 numbers, not'),
        (lambda c: c['field'].update(octaves=2), 'field.coefficients: 6 for an axis, not 22'),
        (lambda c: c.pop('model'), "key 'model' is missing"),
        (lambda c: c['field']['remainder'].pop(), 'field.remainder: 77 numbers, not 78'),
        (
            lambda c: c['field']['remainder'].__setitem__(0, 40000),
            'field.remainder: a number is out of the range of int16',
        ),
        (
            lambda c: c['field'].update(remainder_unit_px=[1.0], remainder=[1]),
            'field.remainder_unit_px: 1 numbers, not 12',
        ),
        (lambda c: c['field']['covariance_factor'].pop(), 'field: covariance of 24 rows, not 25'),
    ],
)
def test_a_damaged_calibration_is_refused_by_file_and_key(tmp_path, change, says) -> None:
    path = tmp_path / 'c.json'
    write_calibration(calibration(), path)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ProductError, match=says) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)


def test_files_that_are_none_are_named(tmp_path: Path) -> None:
    for content in (b'{', b'[]', b'3'):
        (tmp_path / 'c.json').write_bytes(content)
        with pytest.raises(ProductError, match=r'c\.json: .*not') as caught:
            read_calibration(tmp_path / 'c.json')
        assert '\n' not in str(caught.value)
    with pytest.raises(ProductError, match='none.*cannot be read: No such file'):
        read_calibration(tmp_path / 'none')
    with pytest.raises(ProductError, match='cannot be written'):
        write_calibration(calibration(), tmp_path / 'none' / 'c.json')
