# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Bag to products by the tool and by the nodes, against the truth."""

import dataclasses
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from mission_files import params_with  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from starcal_tool import run_python  # type: ignore[import-not-found]
import yaml

from starcal_ground.bags.frames import read_telemetry
from starcal_ground.bags.reader import read_images, Topics
from starcal_ground.cli.node_processes import free_domain
from starcal_ground.comparison import alignment_difference_rad, compare, truth_like
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation import simulated_bag
from starcal_ground.written_files import write_marked
from starcal_ros.camera import line_of_sight, pixel_grid, project
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.records import Calibration, CameraGeometry, Image

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
TINY = ROOT / 'bags' / 'tiny'
INDEPENDENT = ROOT.parent / 'shared' / 'independent'
REAL_SKY = ROOT.parent / 'shared' / 'realsky' / 'granasat'


def read_truth(path: Path) -> CameraGeometry:
    return simulated_bag.true_geometry(json.loads(path.read_text()))


def assert_close_to_truth(calibration: Calibration, truth: CameraGeometry) -> None:
    """Assert each parameter within 5 sigma, and the Mahalanobis error within 5 sigma."""
    compared = compare(calibration, truth_like(calibration, truth))
    sigmas = compared.sigmas if compared.is_aligned else compared.sigmas[:-3]
    assert np.nanmax(np.abs(sigmas)) < 5, sigmas
    count = compared.total.degrees_of_freedom
    assert compared.total.value < count + 5 * np.sqrt(2 * count)  # 5 deviations of chi^2


def test_the_tiny_bag_gives_the_truth(tiny, tiny_products) -> None:
    truth = read_truth(TINY / 'truth.json')
    assert tiny.accepted and tiny.reasons == ()
    assert tiny.images_used == 10 and tiny.images_refused == {}
    assert_close_to_truth(tiny, truth)
    # The prior is 1 px of distortion and 150" of alignment off; a tenth of that must not stay.
    prior = CameraGeometry(
        read_camera_info(TINY / 'camera.yaml'), tiny.geometry.star_tracker_from_camera_xyzw
    )
    before = dataclasses.replace(tiny, geometry=prior)
    (_, error_px), (_, prior_error_px) = (
        compare(one, truth_like(one, truth)).after.worst_and_rms_px for one in (tiny, before)
    )
    assert error_px < 0.2 * prior_error_px
    # Its camera_info has no skew.
    camera = read_camera_info(tiny_products / 'camera_info.yaml')
    assert camera.parameters[1] == 0.0
    grid = pixel_grid(camera, 25, 25)
    moved_px = project(camera, line_of_sight(tiny.geometry.camera, grid)) - grid
    worst_px = np.linalg.norm(moved_px, axis=-1).max()
    assert worst_px == pytest.approx(tiny.zero_skew_cost_px, rel=1e-6)


def test_recorded_observations_give_the_same_calibration(tiny_products, tmp_path, starcal) -> None:
    """No report is written, and an earlier one is removed, where none is wanted."""
    write_marked(tmp_path / 'report.html', 'of earlier products')
    given = ['--params', TINY / 'params.yaml', '-o', tmp_path, '--no-report']
    done = starcal('calibrate', tiny_products / 'observations.mcap', *given)
    assert done.status == 0 and f'\nproducts written to {tmp_path}\n' in done.out, done.err
    assert not (tmp_path / 'report.html').exists()
    files = (folder / 'calibration.json' for folder in (tiny_products, tmp_path))
    first, second = (json.loads(path.read_text()) for path in files)
    second['provenance'] = first['provenance']  # the one names images, the other observations
    assert first == second


def test_the_gate_refuses_with_status_3_and_writes_products(few_images, tmp_path, starcal) -> None:
    of_nodes = {'autostart': True, 'attitude_timeout_s': 2.0, 'use_sim_time': True}
    params = params_with(tmp_path, max_change_px=1e-6, **of_nodes)
    done = starcal('calibrate', few_images, '--params', params, '-o', tmp_path / 'out')
    assert (done.status, done.err) == (3, '')
    assert 'max_change_px' in done.out
    calibration = read_calibration(tmp_path / 'out' / 'calibration.json')
    assert not calibration.accepted
    assert 'max_change_px' in calibration.reasons[0]
    assert (tmp_path / 'out' / 'camera_info.yaml').is_file()


def test_the_tiny_bag_is_small_and_says_what_it_is() -> None:
    assert sum(file.stat().st_size for file in TINY.iterdir()) < 2_000_000
    truth = json.loads((TINY / 'truth.json').read_text())
    made = synthetic.scenario('tiny', truth['seed'])
    assert truth['k_true'] == made.truth.camera.intrinsics.tolist()
    assert truth['d_true'] == made.truth.camera.distortion.tolist()
    geometry = simulated_bag.true_geometry(truth)
    angles_rad = alignment_difference_rad(geometry, made.truth)
    assert np.abs(angles_rad).max() < 1e-14  # there and back through a matrix
    prior = read_camera_info(TINY / 'camera.yaml')
    assert prior.parameters.tolist() == [*truth['k_prior'], *truth['d_prior']]


def test_bright_stars_of_the_bag_stand_where_truth_and_attitude_say() -> None:
    """Conventions of bag and truth file, by an independent formula."""
    truth = json.loads((TINY / 'truth.json').read_text())
    fx, skew, fy, cx, cy = truth['k_true']
    k1, k2, k3, p1, p2 = truth['d_true']
    made = synthetic.scenario('tiny', truth['seed'])
    attitudes = read_telemetry([TINY], Topics('', simulated_bag.ATTITUDE_TOPIC)).attitudes
    for index, image in enumerate(read_images([TINY], simulated_bag.IMAGE_TOPIC)):
        assert isinstance(image, Image)
        shown = synthetic.scene(made, index)
        xyzw, _ = attitudes.at(image.time_ns, 1.0)
        icrf_from_tracker = Rotation.from_quat(xyzw).as_matrix()
        e = shown.direction_icrf @ (np.array(truth['A_true']) @ icrf_from_tracker.T).T
        x, y = e[:, 0] / e[:, 2], e[:, 1] / e[:, 2]
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        xd = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        yd = radial * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        u, v = fx * xd + skew * yd + cx, fy * yd + cy
        inside = (u > 8) & (u < truth['width'] - 9) & (v > 8) & (v < truth['height'] - 9)
        bright = np.flatnonzero(inside)[np.argsort(shown.magnitude[inside])[:5]]
        for k in bright:
            i, j = round(v[k]), round(u[k])
            stamp = image.pixels[i - 5 : i + 6, j - 5 : j + 6].astype(float)
            row, column = np.unravel_index(stamp.argmax(), stamp.shape)
            # 40" about the tracker's z axis and 10" about the others are 0.4 px at most.
            assert abs(row - 5) <= 2 and abs(column - 5) <= 2


def test_a_zenith_campaign_gives_the_truth(tmp_path, starcal) -> None:
    scenario = dataclasses.replace(synthetic.scenario('small', 2), image_count=6)
    made = simulated_bag.write_bag(scenario, tmp_path / 'bag.mcap')
    out = tmp_path / 'out'
    assert starcal('calibrate', made.bag, '--params', made.params, '-o', out).status == 0
    calibration = read_calibration(out / 'calibration.json')
    assert_close_to_truth(calibration, read_truth(made.truth))


def test_a_bag_cut_off_is_used_up_to_the_damage(tmp_path) -> None:
    """In a process of its own, whose log is in the standard error stream."""
    whole = (TINY / 'tiny_0.mcap').read_bytes()
    bag = tmp_path / 'cut.mcap'
    bag.write_bytes(whole[: len(whole) * 7 // 10])
    given = ['calibrate', bag, '--params', TINY / 'params.yaml', '-o', tmp_path / 'out']
    done = run_python('-m', 'starcal_ground.cli.main', *given, '--no-report')
    assert done.returncode == 0, done.stderr
    damage, refused = done.stderr.splitlines()
    assert 'truncated' in damage and '1 of 7 images refused, no_attitude' in refused
    calibration = read_calibration(tmp_path / 'out' / 'calibration.json')
    assert 3 <= calibration.images_used < 10
    assert_close_to_truth(calibration, read_truth(TINY / 'truth.json'))


@pytest.mark.nodes
def test_a_ros_domain_is_held_before_it_has_a_participant() -> None:
    """Nodes of two runs of the tests answered for each other."""
    with free_domain() as one, free_domain() as other:
        assert one['ROS_DOMAIN_ID'] != other['ROS_DOMAIN_ID'] != os.environ['ROS_DOMAIN_ID']


@pytest.mark.nodes
def test_the_demonstration_on_the_real_graph(tmp_path, starcal) -> None:
    pytest.importorskip('starcal.msg')
    done = starcal('demo', '-o', tmp_path)
    assert done.status == 0, done
    assert 'sigma' in done.out and 'alignment z' in done.out
    assert done.out.endswith(f'open {tmp_path / "report.html"}\n')
    assert (tmp_path / 'report.html').stat().st_size > 100_000  # with its pictures
    found = read_calibration(tmp_path / 'calibration.json')
    assert (found.images_used, dict(found.images_refused)) == (10, {})


@pytest.mark.nodes
def test_a_demonstration_that_is_ended_leaves_no_process(tmp_path) -> None:
    pytest.importorskip('starcal.msg')
    psutil = pytest.importorskip('psutil')
    command = [sys.executable, '-m', 'starcal_ground.cli.main', 'demo', '-o', str(tmp_path)]
    tool = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    # The log of the last is there before its process is.
    while len(children := psutil.Process(tool.pid).children(recursive=True)) < 3:
        assert tool.poll() is None
        time.sleep(0.05)
    tool.send_signal(signal.SIGTERM)
    _, err = tool.communicate()
    assert (tool.returncode, err) == (130, 'starcal: interrupted\n')
    assert not any(child.is_running() for child in children)


@pytest.mark.skipif(not INDEPENDENT.is_dir(), reason='the independent bag is not here')
def test_a_bag_of_another_simulator_gives_the_truth(tmp_path, starcal) -> None:
    truth = json.loads((INDEPENDENT / 'small_101.json').read_text())
    k, d = truth['k_prior'], truth['d_prior']
    K = [k[0], k[1], k[3], 0.0, k[2], k[4], 0.0, 0.0, 1.0]
    camera = {
        'image_width': truth['width'],
        'image_height': truth['height'],
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': K},
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [*d[:2], d[3], d[4], d[2]]},
    }
    (tmp_path / 'camera.yaml').write_text(yaml.safe_dump(camera))
    values = {
        'camera_info_url': 'camera.yaml',
        'prior_alignment': Rotation.from_matrix(np.array(truth['A_prior']).T).as_quat().tolist(),
        'star_tracker_sigma_arcsec': [truth['sigma_st_arcsec']] * 3,
    }
    params = tmp_path / 'params.yaml'
    params.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}))
    bag = INDEPENDENT / truth['bag']
    done = starcal('calibrate', bag, '--params', params, '-o', tmp_path / 'out')
    assert done.status == 0, done.err
    calibration = read_calibration(tmp_path / 'out' / 'calibration.json')
    assert_close_to_truth(calibration, simulated_bag.true_geometry(truth))


@pytest.mark.skipif(not REAL_SKY.is_dir(), reason='the bag of the real sky is not here')
def test_a_real_sky_calibrates_and_its_wrong_attitudes_are_refused(tmp_path, starcal) -> None:
    params = ROOT / 'config' / 'examples' / 'realsky.yaml'
    done = starcal(
        'calibrate', REAL_SKY, '--params', params, '-o', tmp_path,
        '--image-topic', '/opnav/image_raw', '--attitude-topic', '/star_tracker/attitude',
    )  # fmt: skip
    assert done.status == 0, done.err
    calibration = read_calibration(tmp_path / 'calibration.json')
    assert calibration.images_used == 9
    assert dict(calibration.images_refused) == {'no_match': 2}
    # 1597 stars at 0.109 px when written; an independent fit of these frames left 0.113 px.
    assert calibration.stars_used >= 1200
    assert calibration.residual_rms_px <= 0.115
    # The independent fit: fx 2659.2, fy 2657.6, without refraction and with other stars.
    fx, fy = calibration.geometry.camera.parameters[[0, 2]]
    assert np.abs(np.array([fx, fy]) - [2659.2, 2657.6]).max() < 2.0
    assert abs(fx - fy) < 1.0  # pixels are square; left in, refraction makes them differ by 1.4 px
