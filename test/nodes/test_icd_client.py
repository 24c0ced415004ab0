# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""An integrator's client: generated interfaces and names of the ICD, no import of starcal_ros."""

import array
from collections.abc import Iterator
import json
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped, TransformStamped
import numpy as np
import pytest
from rosbags import highlevel as rosbags
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from vehicle import BOTH  # type: ignore[import-not-found]

from starcal.msg import Calibration, StarObservations
from starcal.srv import Calibrate

pytestmark = pytest.mark.nodes

ARCSECOND_RAD = np.pi / 648000


def bag_messages(folder: Path) -> Iterator[Any]:
    """Images and attitudes of a bag as rclpy messages, in order."""
    with rosbags.AnyReader([folder]) as reader:
        # The velocity of the observer is not in the contract of this client.
        wanted = [one for one in reader.connections if 'Twist' not in one.msgtype]
        for connection, _, data in reader.messages(wanted):
            found: Any = reader.deserialize(data, connection.msgtype)
            made: Any
            if connection.msgtype == 'sensor_msgs/msg/Image':
                made = Image(height=found.height, width=found.width, encoding=found.encoding)
                made.step, made.is_bigendian = found.step, found.is_bigendian
                made.data = array.array('B', found.data.tobytes())
            else:
                made = QuaternionStamped()
                for axis in 'xyzw':
                    setattr(made.quaternion, axis, getattr(found.quaternion, axis))
            made.header.stamp.sec = found.header.stamp.sec
            made.header.stamp.nanosec = found.header.stamp.nanosec
            made.header.frame_id = found.header.frame_id
            yield made


def test_calibrates_through_the_icd(vehicle) -> None:
    """Images and attitudes give the true camera, also to late subscribers."""
    for name in BOTH:
        vehicle.start(name)
    early = vehicle.latched(CameraInfo, 'camera_info')
    observations: list[Any] = vehicle.collect(StarObservations, 'observations')
    images = vehicle.publisher(Image, 'image', 20)
    attitudes = vehicle.publisher(QuaternionStamped, 'attitude')
    vehicle.until_listened(listeners=2)

    sent = 0
    for message in bag_messages(vehicle.bag):
        if isinstance(message, Image):
            # An observer works at its own speed: two images ahead are enough.
            vehicle.until(lambda enough=sent - 2: len(observations) >= enough)
            images.publish(message)
            sent += 1
        else:
            attitudes.publish(message)
    vehicle.until(lambda: len(observations) == sent)
    assert [o.refusal for o in observations] == [''] * sent
    for one in observations:
        n = len(one.catalog_id)
        assert n > 50
        sizes = [len(one.direction_icrf), len(one.measured_px), len(one.covariance_px2)]
        assert sizes == [3 * n, 2 * n, 3 * n]
        assert len(one.magnitude) == len(one.flux_dn) == len(one.snr) == n
        lengths = np.linalg.norm(np.reshape(one.direction_icrf, (n, 3)), axis=1)
        assert np.abs(lengths - 1).max() < 1e-12

    status = vehicle.until_images(sent)
    assert sum(status.coverage) == status.stars == sum(len(o.snr) for o in observations)
    assert len(status.coverage) == status.coverage_rows * status.coverage_cols
    assert len(status.predicted_sigma) == len(status.parameter_names)

    trial = vehicle.call(Calibrate, '/calibrator/solve', dry_run=True)
    assert trial.success, trial.message
    assert trial.calibration.stars_used > 0
    assert not any(info.k.any() for info in early), 'before one is active, none is calibrated'

    vehicle.calibrate()
    infos = vehicle.latched(CameraInfo, 'camera_info')
    alignments = vehicle.latched(TransformStamped, 'alignment')
    calibrations = vehicle.latched(Calibration, 'calibration')
    vehicle.until(lambda: infos and alignments and calibrations and early[-1].k[0])
    check_products(infos[0], alignments[0], calibrations[0], vehicle.bag)

    diagnostics = vehicle.collect(DiagnosticArray, '/diagnostics')
    names = {f'starcal: {name}' for name in BOTH}
    vehicle.until(lambda: names <= {m.status[0].name for m in diagnostics})
    # The bag is over: where it took ten seconds to send, the nodes report that too.
    doubts = [m.status[0].message for m in diagnostics if m.status[0].level != b'\x00']
    assert all(': no message for ' in doubt for doubt in doubts), doubts


def check_products(info: Any, alignment: Any, calibration: Any, folder: Path) -> None:
    """The three latched messages agree with each other and, within 5 sigma, with the truth."""
    truth = json.loads((folder / 'truth.json').read_text())
    assert calibration.accepted and not calibration.reasons
    sigma = np.sqrt(np.diag(np.reshape(calibration.covariance, (13, 13))))
    assert list(calibration.camera.parameter_names) == list(calibration.parameter_names)[:10]
    off = np.array(calibration.camera.parameters) - np.r_[truth['k_true'], truth['d_true']]
    free = sigma[:10] > 0
    assert free.sum() >= 5
    assert np.abs(off[free] / sigma[:10][free]).max() < 5
    # plumb_bob has another order; at this skew the refit without it moves little.
    assert info.distortion_model == 'plumb_bob'
    assert (info.width, info.height) == (truth['width'], truth['height'])
    assert info.k[1] == 0.0
    camera = calibration.camera
    found = dict(zip(camera.parameter_names, camera.parameters, strict=True))
    assert abs(info.k[0] - found['fx']) < 1.0
    assert abs(info.d[0] - found['k1']) < 0.01
    assert abs(info.d[2] - found['p1']) < 0.001
    assert (alignment.header.frame_id, alignment.child_frame_id) == (
        calibration.alignment.parent_frame,
        calibration.header.frame_id,
    )
    q = alignment.transform.rotation
    assert q == calibration.alignment.rotation
    camera_from_st = np.array(truth['A_true'])
    parent_from_child = Rotation.from_quat([q.x, q.y, q.z, q.w])
    error = parent_from_child.inv() * Rotation.from_matrix(camera_from_st.T)
    assert error.magnitude() < 5 * np.linalg.norm(sigma[10:])
    assert 0 < np.linalg.norm(sigma[10:]) < 60 * ARCSECOND_RAD
