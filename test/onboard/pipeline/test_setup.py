# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The setup: what it holds of the parameters, and what it refuses."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from tiny_campaign import SCENARIO, values  # type: ignore[import-not-found]

from bench.narrow import scenario_of
from starcal_ground.products import write_camera_info
from starcal_ros.camera import CameraModel
from starcal_ros.errors import CatalogError, OptionError, ProductError
from starcal_ros.options import names_of, option_fields
from starcal_ros.pipeline.setup import (
    check_field_of_stars,
    load_setup,
    OPTION_CLASSES,
    read_setup,
    Setup,
)
from starcal_ros.sky.catalog import load_catalog


@pytest.fixture(scope='module')
def setup(camera_yaml: Path) -> Setup:
    return load_setup(values(camera_yaml))


def test_a_deep_catalog_need_not_cover_the_sky() -> None:
    given = scenario_of(0.3, 3)
    assert given.sky is not None
    check_field_of_stars(given.sky, 14.7, given.prior.camera)
    with pytest.raises(OptionError, match=r'magnitude_limit: 9 leaves \d+ stars in the catalog'):
        check_field_of_stars(load_catalog(None, 9.0), 9.0, given.prior.camera)


def test_a_setup_holds_what_the_parameters_say(camera_yaml: Path) -> None:
    made = load_setup(
        values(
            camera_yaml,
            centroid='moment',
            method='single',
            estimate=['fx', 'fy'],
            max_attitude_gap_s=7,
            magnitude_limit=6.0,
            max_change_px=0.3,
            camera_frame='left_eye',
            use_sim_time=True,
        )
    )
    assert made.centroid.centroid == 'moment'
    assert made.calibration.method == 'single'
    assert made.calibration.estimate == ('fx', 'fy')
    assert made.attitude.max_attitude_gap_s == 7.0
    assert made.gate.max_change_px == 0.3
    assert made.frames.camera_frame == 'left_eye'
    assert made.catalog.magnitude.max() <= 6.0
    assert made.detector.dark is None
    np.testing.assert_array_equal(made.prior.camera.parameters, SCENARIO.prior.camera.parameters)


def test_a_setup_holds_the_options_of_every_stage(setup: Setup) -> None:
    """None that one of its fields has is missing where parameters are declared and told."""
    held = [
        value
        for value in vars(setup).values()
        if dataclasses.is_dataclass(value) and option_fields(type(value))
    ]
    assert tuple(map(type, held)) == OPTION_CLASSES and len(held) == 8
    for group in held:
        assert names_of(type(group)) <= setup.options().keys()


def test_another_lens_model_starts_from_the_prior_camera(
    camera_yaml: Path, tmp_path: Path
) -> None:
    wide = load_setup(values(camera_yaml, lens_model='rational_polynomial'))
    prior = wide.prior.camera
    assert prior.model == 'rational_polynomial'
    np.testing.assert_array_equal(prior.parameters[:10], SCENARIO.prior.camera.parameters)
    fisheye = CameraModel(
        640, 480, np.array([160, 0, 155, 322, 236, -0.02, 0.01, -0.004, 5e-4]), 'equidistant'
    )
    write_camera_info(fisheye, tmp_path / 'fisheye.yaml')
    with pytest.raises(OptionError, match='lens_model: plumb_bob does not cover the field'):
        load_setup(values(tmp_path / 'fisheye.yaml', lens_model='plumb_bob'))


def test_a_rounded_alignment_is_made_unit(camera_yaml: Path) -> None:
    q = np.round(SCENARIO.prior.star_tracker_from_camera_xyzw, 4)
    made = load_setup(values(camera_yaml, prior_alignment=q.tolist()))
    assert np.linalg.norm(made.prior.star_tracker_from_camera_xyzw) == pytest.approx(1, abs=1e-15)


def test_the_parameters_of_a_node_are_known_where_it_asks(camera_yaml: Path) -> None:
    load_setup(values(camera_yaml, autostart=False))


def test_an_override_of_ros_in_a_parameter_file_is_not_an_option(
    camera_yaml: Path, tmp_path: Path
) -> None:
    """The nodes' QoS override, nested as ROS reads it, in the file that the tool reads too."""
    params = tmp_path / 'params.yaml'
    params.write_text(
        f'/**:\n  ros__parameters:\n    camera_info_url: {camera_yaml}\n'
        '    qos_overrides: {/image: {subscription: {reliability: best_effort}}}\n'
    )
    assert read_setup(params).prior.camera.width > 0


@pytest.mark.parametrize(
    ('wrong', 'says'),
    [
        ({'shutter': 'rolling'}, 'readout_s: not set, which shutter: rolling needs'),
        ({'readout_s': 0.03}, 'readout_s: 0.03 s, but shutter is unknown; set rolling'),
        ({'observer_velocity_m_s': [0, 0, 3e8]}, r'observer_velocity_m_s\[2\]: .* is not within'),
        ({'max_residual_rms': 1.0}, 'max_residual_rms: no such parameter'),
        ({'camera_info_url': ''}, 'camera_info_url: not set'),
        ({'prior_alignment': [0.0, 0.0, 0.0, 1e-4]}, 'prior_alignment: .* not a unit quaternion'),
        ({'prior_alignment': [0.0, 0.0, 0.0, 1.1]}, r'prior_alignment: .* its norm is 1\.1$'),
        (
            {'prior_alignment': [90.0, 0.0, 10.0, 1.0]},
            r'norm is 90\.559.*angles in degrees are not a quat',
        ),
        ({'prior_alignment': [0.0, 0.0, 1.0]}, 'prior_alignment: 3 numbers, not 4'),
        (
            {'method': 'per_image', 'alignment_temperature': True},
            'alignment_temperature: the method per_image',
        ),
        (
            {'lens_model': 'rational_polynomial', 'estimate': ['fx', 's1']},
            'estimate: .* the lens model rational_polynomial',
        ),
        (
            {'lens_model': 'rational_polynomial', 'prior_sigma': [0.0] * 10},
            'prior_sigma: .* the lens model rational_polynomial',
        ),
        ({'autstart': False}, 'autstart: no such parameter .did you mean autostart'),
        ({'autostart': 'maybe'}, 'autostart: .*maybe'),
    ],
)
def test_a_wrong_parameter_is_named(
    camera_yaml: Path, wrong: dict[str, object], says: str
) -> None:
    with pytest.raises(OptionError, match=says):
        load_setup(values(camera_yaml, **wrong))


def test_a_wrong_file_is_named(camera_yaml: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match='camera_info_url: .*missing.yaml: no such file'):
        load_setup(values(tmp_path / 'missing.yaml'))
    (tmp_path / 'stars.csv').write_text('these are no stars')
    for name, kind in (('stars.csv', CatalogError), ('missing.csv', OptionError)):
        with pytest.raises(kind, match=name):
            load_setup(values(camera_yaml, catalog=str(tmp_path / name)))


def test_zeros_stand_for_an_alignment_not_given(camera_yaml: Path) -> None:
    given = values(camera_yaml)
    assert load_setup(given).is_aligned
    for missing in (
        {**given, 'prior_alignment': [0.0] * 4},
        {'camera_info_url': str(camera_yaml)},
    ):
        assert not load_setup(missing).is_aligned
    assert load_setup({}, prior=SCENARIO.prior).is_aligned


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'fx': 35.0, 'fy': 35.0}, 'fx: 35 px is under 96 px.* is it in mm?'),
        ({'fx': 0.035, 'fy': 0.035}, 'fx: 0.035 px is under 96 px'),
        ({'fx': 35e4, 'fy': 35e4}, 'focal length of 350000 px .* in micrometres'),
        ({'cx': 1.54, 'cy': 1.23}, r'principal point \(1.54, 1.23\) is in the first corner'),
        ({'cx': 5000.0}, 'cx: 5000 px is far outside of the 640 px'),
        ({'fx': 4000.0}, 'fx = 4000 and fy = .* differ by a factor of two'),
    ],
)
def test_a_camera_that_no_lens_makes(tmp_path: Path, changes: dict[str, float], text: str) -> None:
    path = tmp_path / 'camera.yaml'
    write_camera_info(SCENARIO.prior.camera.replace(**changes), path)
    with pytest.raises((OptionError, ProductError), match=text) as refused:
        load_setup(values(path))
    assert str(refused.value).startswith(str(path)) and '\n' not in str(refused.value)


@pytest.mark.parametrize(
    'option', ['camera_info_url', 'catalog', 'dark_frame', 'flat_field', 'bad_pixel_map']
)
def test_a_relative_path_that_leads_nowhere_names_folder_and_remedy(
    camera_yaml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    """The nodes run in a folder that their caller need not have in mind."""
    monkeypatch.chdir(tmp_path)
    given = {**values(camera_yaml), option: 'here/file'}
    expected = f'{option}: here/file: no such file in {tmp_path}, .* give the absolute path'
    with pytest.raises(OptionError, match=expected):
        load_setup(given)
    given = {**values(camera_yaml), 'camera_info_url': camera_yaml.name}
    monkeypatch.chdir(camera_yaml.parent)
    assert load_setup(given).prior.camera.width > 0
