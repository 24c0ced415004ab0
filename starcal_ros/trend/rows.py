# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""One calibration as a row of the table of a trend."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import line_of_sight_jacobian
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.records import Calibration, CameraGeometry

RECORDED, COMPUTED, FAILED = 'recorded', 'computed', 'failed'


@dataclass(frozen=True)
class Row:
    """
    A calibration, or the reason why there is none.

    Attributes
    ----------
    key : str
        Digest of what the row was made from.
    path, kind, error : str
        Source; ``recorded`` (read from a file), ``computed`` (from a bag by this version) or
        ``failed`` with its error.
    software : str
    time_ns, first_ns, last_ns : int
        Middle, first and last image.
    number, active_since_ns : int
        As in `Calibration`; 0 where it was not activated.
    accepted, forced : bool
    reasons : str
    parent_frame, child_frame, lens_model : str
    width, height, images, stars : int
    residual_rms_px, temperature_degc : float
        NaN where not known.
    names : list of str
        Camera parameters; ``sigmas`` has the three alignment angles (rad) too.
    values, sigmas, star_tracker_from_camera_xyzw : list of float
    boresight_sigma_arcsec : list of float
        About the x and the y axis of the camera, of the middle of the detector, in the star
        tracker frame.
    """

    key: str
    path: str
    kind: str
    error: str = ''
    software: str = ''
    time_ns: int = 0
    first_ns: int = 0
    last_ns: int = 0
    number: int = 0
    active_since_ns: int = 0
    accepted: bool = False
    forced: bool = False
    reasons: str = ''
    parent_frame: str = ''
    child_frame: str = ''
    lens_model: str = ''
    width: int = 0
    height: int = 0
    images: int = 0
    stars: int = 0
    residual_rms_px: float = math.nan
    temperature_degc: float = math.nan
    names: list[str] = dataclasses.field(default_factory=list)
    values: list[float] = dataclasses.field(default_factory=list)
    sigmas: list[float] = dataclasses.field(default_factory=list)
    star_tracker_from_camera_xyzw: list[float] = dataclasses.field(default_factory=list)
    boresight_sigma_arcsec: list[float] = dataclasses.field(default_factory=list)

    @property
    def geometry(self) -> CameraGeometry:
        """Camera, without a field, and alignment."""
        camera = CameraModel(self.width, self.height, np.array(self.values), self.lens_model)
        return CameraGeometry(camera, np.array(self.star_tracker_from_camera_xyzw))

    def content(self) -> dict[str, Any]:
        """The fields by name."""
        return dataclasses.asdict(self)


def row_of(
    calibration: Calibration, key: str, path: str, kind: str, temperature_degc: float
) -> Row:
    """Row of a calibration."""
    camera, terms = calibration.geometry.camera, calibration.temperature
    if math.isnan(temperature_degc) and terms is not None:
        temperature_degc = terms.reference_degc
    first_ns = calibration.first_image_ns or calibration.time_ns
    return Row(
        key=key,
        path=path,
        kind=kind,
        software=calibration.provenance.get('software', ''),
        time_ns=(first_ns + calibration.time_ns) // 2,
        first_ns=first_ns,
        last_ns=calibration.time_ns,
        number=calibration.number,
        active_since_ns=calibration.active_since_ns,
        accepted=calibration.accepted,
        forced=calibration.forced,
        reasons='; '.join(calibration.reasons),
        parent_frame=calibration.parent_frame,
        child_frame=calibration.child_frame,
        lens_model=camera.model,
        width=camera.width,
        height=camera.height,
        images=calibration.images_used,
        stars=calibration.stars_used,
        residual_rms_px=calibration.residual_rms_px,
        temperature_degc=temperature_degc,
        names=list(camera.parameter_names),
        values=camera.parameters.tolist(),
        sigmas=calibration.sigma.tolist(),
        star_tracker_from_camera_xyzw=(
            calibration.geometry.star_tracker_from_camera_xyzw.tolist()
        ),
        boresight_sigma_arcsec=_boresight_sigma(calibration).tolist(),
    )


def _boresight_sigma(calibration: Calibration) -> Floats:
    """1-sigma (2,) of the line of sight of the middle, about the x and y axes, arcsec."""
    camera = calibration.geometry.camera
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    _, J = line_of_sight_jacobian(camera, middle)
    covariance = J[0] @ calibration.joint_covariance @ J[0].T
    # A small rotation about x moves the direction along y, one about y along x.
    return np.asarray(np.sqrt(np.diag(covariance)[[1, 0]]) / ARCSECOND_RAD)
