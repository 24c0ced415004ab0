# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Writer of simulated scenarios: a bag, its truth, and the files to calibrate it.

Deliberate mistakes of the set-up serve to practise their diagnosis.
"""

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
from starcal_ground.mirror import mirrored
from starcal_ground.simulation import centroids
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.rendering import images
from starcal_ground.written_files import write_marked
from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import CameraModel
from starcal_ros.constants import NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import read_text
from starcal_ros.records import AttitudeSample, Calibration, CameraGeometry, Image
from starcal_ros.sky.astrometry import earth_velocity_c
from starcal_ros.untrusted import json_value, PRODUCT_BYTES

_AXIS = (0.8, 0.6, 0.0)  # axis of the alignment error, perpendicular to the line of sight


@dataclasses.dataclass(frozen=True)
class Mistakes:
    """
    Mistakes of a bag and its parameter file; none by default.

    Attributes
    ----------
    flip : str
        'left-right' or 'top-bottom': images are mirrored.
    rotate_deg : int
        Images are turned counterclockwise by 90, 180 or 270 degrees.
    attitude_direction, quaternion_order : str
        'inertial_to_st', 'wxyz': the attitudes of the bag, contrary to the parameter file.
    alignment_error_deg, focal_error_percent : float
        Errors of the prior.
    clock_error_s : float
        Delay of the stamps of images.
    smear_px : int
        Length of the streak of each star in the middle of the image, along x.
    gamma : float
        Pixel values are proportional to light to the power 1 / gamma.
    """

    flip: str = ''
    rotate_deg: int = 0
    attitude_direction: str = 'st_to_inertial'
    quaternion_order: str = 'xyzw'
    alignment_error_deg: float = 0.0
    focal_error_percent: float = 0.0
    clock_error_s: float = 0.0
    smear_px: int = 1
    gamma: float = 1.0

    def image(self, image: Image) -> Image:
        """The image with its mistakes, as written to the bag."""
        pixels = image.pixels
        full = float(np.iinfo(pixels.dtype).max if pixels.itemsize == 1 else pixels.max())
        if self.gamma != 1.0:
            light = np.clip(pixels.astype(np.float64) - np.median(pixels), 0.0, None) / full
            curved = 0.05 * full + 0.9 * full * light ** (1 / self.gamma)
            pixels = _as_before(curved, pixels, full)
        turned: Pixels = np.rot90(pixels, self.rotate_deg // 90)  # type: ignore[assignment]
        turned = mirrored(turned, self.flip)
        late_ns = round(self.clock_error_s * NANOSECONDS_PER_SECOND)
        # A copy without gaps, of the same type.
        return Image(image.time_ns + late_ns, turned.copy())

    def attitude(self, icrf_from_star_tracker_xyzw: Floats) -> Floats:
        """The attitude with its mistakes, as written to the bag."""
        sent = np.asarray(icrf_from_star_tracker_xyzw)
        if self.attitude_direction == 'inertial_to_st':
            sent = sent * [-1.0, -1.0, -1.0, 1.0]
        return sent[[3, 0, 1, 2]] if self.quaternion_order == 'wxyz' else sent

    def prior(self, prior: CameraGeometry) -> CameraGeometry:
        """The prior with its mistakes, as written to the parameter file."""
        fx, fy = (float(prior.camera.parameters[k]) for k in (0, 2))
        grown = 1.0 + self.focal_error_percent / 100.0
        turn = Rotation.from_rotvec(math.radians(self.alignment_error_deg) * np.array(_AXIS))
        alignment = prior.star_tracker_from_camera * turn
        return CameraGeometry(
            prior.camera.replace(fx=grown * fx, fy=grown * fy), alignment.as_quat()
        )


def _as_before(changed: Floats, before: Pixels, full: float) -> Pixels:
    """Pixels converted to the given type and clipped to its range."""
    clipped = np.clip(np.rint(changed), 0.0, full)
    return clipped.astype(np.uint8) if before.itemsize == 1 else clipped.astype(np.uint16)


NO_MISTAKES = Mistakes()


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
    mistakes: Mistakes = NO_MISTAKES,
) -> SimulatedBag:
    """
    Render a scenario to a bag, and write its truth and the files to calibrate it.

    A bag folder holds ``truth.json``, ``params.yaml``, ``camera.yaml`` and, for a deep sky,
    ``gaia.csv``; for a single file ``NAME.mcap`` they are ``NAME.json``, ``NAME_params.yaml`` and
    so on. Raises BagError when a file cannot be written, and ProductError as `check_outputs` does.

    Parameters
    ----------
    on_image : callable
        Called with the index of each image written.
    mistakes : Mistakes
        Mistakes of the bag and of the files to calibrate it, recorded in the truth file.
    """
    writer = BagWriter(path)
    if path.suffix == '.mcap':
        beside = (f'{path.stem}.json', *(f'{path.stem}_{name}' for name in _BESIDE[1:]))
    else:
        beside = _BESIDE
    truth, params, camera, table = (writer.file.with_name(name) for name in beside)
    tables = [] if scenario.table is None else [table]
    products.check_outputs((*writer.outputs(), truth, params, camera, *tables))
    products.check_maker(writer.file, truth)
    length_px = mistakes.smear_px if mistakes.smear_px > 1 else 0
    turn_rad = length_px / float(scenario.truth.camera.parameters[0])
    scenario = dataclasses.replace(
        scenario, prior=mistakes.prior(scenario.prior), turn_rad=(0.0, turn_rad, 0.0)
    )
    content = parameters(scenario, f'file://{camera.resolve()}')
    if scenario.table is not None:
        content['/**']['ros__parameters'] |= {
            'catalog': str(table.resolve().with_suffix('.npz')),
            'magnitude_limit': scenario.magnitude_limit,
            'prior_alignment_sigma_deg': math.degrees(synthetic.MOUNTING_SIGMA_RAD),
        }
    true = truth_content(scenario, writer.file.name)
    if mistakes != NO_MISTAKES:
        true['mistakes'] = dataclasses.asdict(mistakes)
    truth_text = json.dumps(true, indent=1) + '\n'
    with writer:
        for index, image in enumerate(images(scenario)):
            samples = synthetic.attitude_samples(scenario, index)
            for sample in (s for s in samples if s.time_ns <= image.time_ns):
                _write_telemetry(writer, sample, mistakes)
            writer.write_image(IMAGE_TOPIC, mistakes.image(image), 'camera')
            for sample in (s for s in samples if s.time_ns > image.time_ns):
                _write_telemetry(writer, sample, mistakes)
            on_image(index)
        # Just before the bag replaces an older one, so that all files are replaced together.
        write_marked(truth, truth_text)
        products.write_camera_info(scenario.prior.camera, camera, 'opnav')
        if scenario.table is not None:
            write_marked(table, scenario.table)
        write_marked(params, products.yaml_text(content))
    return SimulatedBag(path, truth, params, camera)


def _write_telemetry(writer: BagWriter, sample: AttitudeSample, mistakes: Mistakes) -> None:
    # The velocity of the Earth, as in the simulated directions.
    velocity_m_s = earth_velocity_c(sample.time_ns) * SPEED_OF_LIGHT_M_S
    writer.write_velocity(VELOCITY_TOPIC, sample.time_ns, velocity_m_s, 'icrf')
    quaternion = mistakes.attitude(sample.icrf_from_star_tracker_xyzw)
    writer.write_attitude(ATTITUDE_TOPIC, sample.time_ns, quaternion, 'icrf')


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
