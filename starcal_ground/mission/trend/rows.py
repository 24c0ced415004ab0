# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""One calibration as a row of the table of a trend."""

from __future__ import annotations

from dataclasses import dataclass
import hashlib
import math
import posixpath
from typing import Annotated
import urllib.parse

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import Derivatives
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.pipeline.solve import software_version
from starcal_ros.record_fields import check_shape, Count, Finite, Stamp
from starcal_ros.records import Calibration, CameraGeometry, check_drawable
from starcal_ros.text import printable
from starcal_ros.untrusted import check_text

RECORDED, COMPUTED, FAILED = 'recorded', 'computed', 'failed'
_LONGEST = 20_000  # characters of a text: a path has 4096, each of up to four after `printable`
_LONGEST_ERROR = 2000
_LONGEST_NAME, _LONGEST_KEY = 100, 16  # of a bag, and of its key, in the name of a folder
_MOST, _LEAST = 1e15, 1e-30  # of a number whose square and its inverse must stay finite


@dataclass(frozen=True)
class Row:
    """
    A calibration, or the reason why there is none.

    Raises ValueError in one line, for a row that the page could not show.

    Attributes
    ----------
    key : str
        Digest of what the row was made from.
    path, kind, error : str
        Source; ``recorded`` (read from a file), ``computed`` (from a bag by this version) or
        ``failed`` with its error.
    software : str
        That made the calibration, or that failed to.
    time_ns, first_ns, last_ns : int
        Middle, first and last image.
    active_since_ns : int
        0 where it was not activated.
    residual_rms_px, temperature_degc : float
        NaN where not known.
    names : tuple of str
        Camera parameters; ``sigmas`` has the three alignment angles (rad) too.
    values, sigmas, star_tracker_from_camera_xyzw : tuple of float
    boresight_sigma_arcsec : tuple of float
        About the x and the y axis of the camera, of the middle of the detector, in the star
        tracker frame.
    spacecraft, camera : str
        Empty where nothing names them.
    stamp : str
        Digest of name, size and time, or etag, of the file when it was read.
    size_bytes : int
    is_passing : bool
        A failure that may pass: the file could not be reached.
    """

    key: str
    path: str
    kind: str
    error: str = ''
    software: str = ''
    time_ns: Stamp = 0
    first_ns: Stamp = 0
    last_ns: Stamp = 0
    number: int = 0
    active_since_ns: Stamp = 0
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
    names: tuple[str, ...] = ()
    values: Annotated[tuple[float, ...], Finite()] = ()
    sigmas: tuple[float, ...] = ()
    star_tracker_from_camera_xyzw: Annotated[tuple[float, ...], Finite()] = ()
    boresight_sigma_arcsec: tuple[float, ...] = ()
    spacecraft: str = ''
    camera: str = ''
    stamp: str = ''
    size_bytes: Count = 0
    is_passing: bool = False

    def __post_init__(self) -> None:
        """Check what `series` and `trend_page` rely on."""
        for name, value in vars(self).items():
            if isinstance(value, str) and len(check_text(value)) > _LONGEST:
                raise ValueError(f'{name}: {len(value)} characters')
        if self.error:
            return
        names = self.geometry.camera.parameter_names
        if self.names != names:
            raise ValueError(f'names: not {", ".join(names)}')
        lengths = {'sigmas': len(names) + 3, 'boresight_sigma_arcsec': 2}
        for name, length in {**lengths, 'star_tracker_from_camera_xyzw': 4}.items():
            check_shape((len(getattr(self, name)),), (length,), name, {})
        for number in (*self.sigmas, *self.boresight_sigma_arcsec, self.temperature_degc):
            if abs(number) > _MOST or 0.0 < abs(number) < _LEAST:
                raise ValueError(f'{number:.6g} is not a plausible sigma or temperature')
        check_drawable(self.geometry)

    @property
    def geometry(self) -> CameraGeometry:
        """Camera, without a field, and alignment."""
        camera = CameraModel(self.width, self.height, np.array(self.values), self.lens_model)
        return CameraGeometry(camera, np.array(self.star_tracker_from_camera_xyzw))


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
        path=printable(path),
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
        names=camera.parameter_names,
        values=tuple(camera.parameters.tolist()),
        sigmas=tuple(calibration.sigma.tolist()),
        star_tracker_from_camera_xyzw=tuple(
            calibration.geometry.star_tracker_from_camera_xyzw.tolist()
        ),
        boresight_sigma_arcsec=tuple(_boresight_sigma(calibration).tolist()),
    )


def kept_name(row: Row) -> str:
    """Path of the folder of a bag below the folder of kept calibrations."""
    bag = posixpath.basename(row.path).removesuffix('.mcap')
    spacecraft, camera, bag = (
        urllib.parse.quote(name, safe=' ') for name in (row.spacecraft, row.camera, bag)
    )
    series = f'spacecraft={spacecraft or "-"}/camera={camera or "-"}'
    return f'{series}/{bag[:_LONGEST_NAME]}-{row.key[:_LONGEST_KEY]}'


def failure(url: str, error: str) -> Row:
    """Row of a calibration or bag that this version cannot use; a file has one at a time."""
    return Row(
        key=hashlib.sha256(repr(url).encode()).hexdigest(),
        path=printable(url),
        kind=FAILED,
        error=printable(' '.join(error.split()) or 'failed')[:_LONGEST_ERROR],
        software=f'starcal {software_version()}',
    )


def _boresight_sigma(calibration: Calibration) -> Floats:
    """1-sigma (2,) of the line of sight of the middle, about the x and y axes, arcsec."""
    camera = calibration.geometry.camera
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    found = Derivatives.at(camera, middle)
    J, of_pixel = found.J[0], found.by_pixel[0] * calibration.map_covariance.unresolved_px
    covariance = J @ calibration.map_covariance.matrix @ J.T + of_pixel @ of_pixel.T
    # A small rotation about x moves the direction along y, one about y along x.
    return np.asarray(np.sqrt(np.diag(covariance)[[1, 0]]) / ARCSECOND_RAD)
