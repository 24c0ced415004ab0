# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Writer of simulated scenarios: a bag, its truth, and the files to calibrate it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground import products
from starcal_ground.bag_writer import BagWriter
from starcal_ground.comparison import truth_like
from starcal_ground.simulation import centroids
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.rendering import images
from starcal_ros.camera import CameraModel
from starcal_ros.constants import NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import read_text, write_atomically
from starcal_ros.records import AttitudeSample, Calibration, CameraGeometry
from starcal_ros.sky.astrometry import earth_velocity_c
from starcal_ros.untrusted import json_value, PRODUCT_BYTES

_BESIDE = ('truth.json', 'params.yaml', 'camera.yaml', 'gaia.csv')
IMAGE_TOPIC = '/opnav/image_raw'
ATTITUDE_TOPIC = '/star_tracker/attitude'
VELOCITY_TOPIC = '/spacecraft/velocity'


@dataclasses.dataclass(frozen=True)
class SimulatedBag:
    """Paths of a simulated bag, its truth, and the parameter and camera files to calibrate it."""

    bag: Path
    truth: Path
    params: Path
    camera: Path


def truth_content(scenario: synthetic.Scenario, bag_name: str) -> dict[str, object]:
    """Content of the truth file of a bag, a JSON object."""
    true, prior = scenario.truth, scenario.prior
    bounds = [centroids.scene_bound(scenario, shown) for shown in synthetic.scenes(scenario)]
    snr = np.concatenate([of_scene for _, of_scene, _ in bounds])
    return {
        'scenario': scenario.name,
        'seed': scenario.seed,
        'bag': bag_name,
        'width': true.camera.width,
        'height': true.camera.height,
        'k_true': true.camera.intrinsics.tolist(),
        'lens_model': true.camera.model,
        'd_true': true.camera.distortion.tolist(),
        'k_prior': prior.camera.intrinsics.tolist(),
        'd_prior': prior.camera.distortion.tolist(),
        'A_true': true.star_tracker_from_camera.inv().as_matrix().tolist(),
        'A_prior': prior.star_tracker_from_camera.inv().as_matrix().tolist(),
        'sigma_st_arcsec': max(scenario.star_tracker_sigma_arcsec),
        'sigma_st_axes_arcsec': list(scenario.star_tracker_sigma_arcsec),
        'images': scenario.image_count,
        'stars': len(snr),
        'stars_snr5': int((snr > centroids.BOUND_SNR).sum()),
        'crlb_keep': [
            true.camera.parameter_names.index(name) for name in centroids.bound_names(true.camera)
        ],
        'crlb_cov': centroids.cramer_rao_covariance(scenario, bounds).tolist(),
        't0': scenario.start_ns / NANOSECONDS_PER_SECOND,
        'step': scenario.cadence_s,
    }


def true_geometry(content: Mapping[str, Any]) -> CameraGeometry:
    """The true camera and alignment of a truth file's JSON object."""
    parameters = np.array([*content['k_true'], *content['d_true']])
    model = content.get('lens_model', 'plumb_bob')
    camera = CameraModel(content['width'], content['height'], parameters, model)
    star_tracker_from_camera = Rotation.from_matrix(np.array(content['A_true']).T)
    return CameraGeometry(camera, star_tracker_from_camera.as_quat())


def read_truth(path: Path, like: Calibration) -> Calibration | None:
    """
    The truth of a simulated bag as a calibration like another one; None for another file.

    Raises ProductError when it is damaged.
    """
    try:
        content = json_value(read_text(path, PRODUCT_BYTES)) if path.suffix == '.json' else None
    except (ProductError, ValueError):
        return None
    if not (isinstance(content, dict) and 'k_true' in content):
        return None
    try:
        return truth_like(like, true_geometry(content))
    except (ValueError, KeyError, TypeError) as error:
        raise ProductError(f'{path}: not the truth of a simulated bag: {error}') from error


def write_bag(
    scenario: synthetic.Scenario,
    path: Path,
    on_image: Callable[[int], None] = lambda index: None,
) -> SimulatedBag:
    """
    Render a scenario to a bag, and write its truth and the files to calibrate it.

    A bag folder holds ``truth.json``, ``params.yaml``, ``camera.yaml`` and, for a deep sky,
    ``gaia.csv``; beside a single file ``NAME.mcap`` they are ``NAME_truth.json`` and so on. Raises
    BagError when a file cannot be written, and ProductError as `check_outputs` does.

    Parameters
    ----------
    on_image : callable
        Called with the index of each image written.
    """
    writer = BagWriter(path)
    truth, params, camera, table = map(writer.beside, _BESIDE)
    tables = [] if scenario.table is None else [table]
    products.check_outputs((*writer.outputs(), truth, params, camera, *tables))
    content = parameters(scenario, f'file://{camera.resolve()}')
    if scenario.table is not None:
        content['/**']['ros__parameters'] |= {
            'catalog': str(table.resolve().with_suffix('.npz')),
            'magnitude_limit': scenario.magnitude_limit,
            'prior_alignment_sigma_deg': math.degrees(synthetic.MOUNTING_SIGMA_RAD),
        }
    truth_text = json.dumps(truth_content(scenario, writer.file.name), indent=1) + '\n'
    with writer:
        for index, image in enumerate(images(scenario)):
            samples = synthetic.attitude_samples(scenario, index)
            for sample in (s for s in samples if s.time_ns <= image.time_ns):
                _write_telemetry(writer, sample)
            writer.write_image(IMAGE_TOPIC, image, 'camera')
            for sample in (s for s in samples if s.time_ns > image.time_ns):
                _write_telemetry(writer, sample)
            on_image(index)
        # Just before the bag replaces an older one, so that all files are replaced together.
        write_atomically(truth, truth_text)
        products.write_camera_info(scenario.prior.camera, camera, 'opnav')
        if scenario.table is not None:
            write_atomically(table, scenario.table)
        write_atomically(params, products.yaml_text(content))
    return SimulatedBag(path, truth, params, camera)


def _write_telemetry(writer: BagWriter, sample: AttitudeSample) -> None:
    # The velocity of the Earth, as in the simulated directions.
    velocity_m_s = earth_velocity_c(sample.time_ns) * SPEED_OF_LIGHT_M_S
    writer.write_velocity(VELOCITY_TOPIC, sample.time_ns, velocity_m_s, 'icrf')
    xyzw = sample.icrf_from_star_tracker_xyzw
    writer.write_attitude(ATTITUDE_TOPIC, sample.time_ns, xyzw, 'icrf')


def parameters(
    scenario: synthetic.Scenario, camera_url: str
) -> dict[str, dict[str, dict[str, Any]]]:
    """Content of the ROS parameter file with the prior of a scenario."""
    values = {
        'camera_info_url': camera_url,
        'prior_alignment': scenario.prior.star_tracker_from_camera_xyzw.tolist(),
        'star_tracker_frame': 'star_tracker',
        'camera_frame': 'camera',
        'star_tracker_sigma_arcsec': list(scenario.star_tracker_sigma_arcsec),
        'shutter': 'global',
    }
    return {'/**': {'ros__parameters': values}}
