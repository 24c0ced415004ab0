"""What a camera is calibrated with: the options of every stage, and what they name, loaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

import cv2
import numpy as np
from numpy.typing import NDArray

from starcal_ros.assessment.gate import GateOptions
from starcal_ros.errors import OptionError
from starcal_ros.estimation.calibrate import CalibrationOptions, check_options
from starcal_ros.identification.star_finder import IdentificationOptions
from starcal_ros.image.centroiding import CentroidOptions
from starcal_ros.image.frame_checks import ScreeningOptions
from starcal_ros.image.hot_pixels import (
    FixedPatternOptions,
    hot_in_dark,
    HotPixels,
    NO_HOT_PIXELS,
)
from starcal_ros.options import (
    from_mapping,
    holds_options,
    is_of_ros,
    names_of,
    nearest,
    option,
    OptionValue,
)
from starcal_ros.products.camera_yaml import read_camera_info
from starcal_ros.records import CameraGeometry
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.attitude import AttitudeOptions
from starcal_ros.sky.catalog import load_catalog, StarCatalog


@dataclass(frozen=True)
class SetupOptions:
    """Prior camera and alignment, frames, and the files that go with the camera."""

    camera_info_url: str = option(
        '', 'prior camera: a ROS camera YAML, file:// or package:// URL or a path'
    )
    prior_alignment: tuple[float, ...] = option(
        (0.0, 0.0, 0.0, 1.0),
        'prior orientation of the camera in the star tracker frame, quaternion x, y, z, w',
        low=-1.0,
        high=1.0,
        length=4,
    )
    star_tracker_frame: str = option('star_tracker', 'name of the star tracker frame')
    camera_frame: str = option('camera_optical_frame', 'name of the camera optical frame')
    catalog: str = option('', 'star catalog file; empty: the bundled one')
    dark_frame: str = option(
        '', "dark frame, a PNG or TIFF of the camera's size and depth, subtracted; empty: none"
    )


@dataclass(frozen=True)
class Setup:
    """Options of every stage, and what they name, loaded."""

    frames: SetupOptions
    attitude: AttitudeOptions
    site: SiteOptions
    screening: ScreeningOptions
    fixed_pattern: FixedPatternOptions
    centroid: CentroidOptions
    identification: IdentificationOptions
    calibration: CalibrationOptions
    gate: GateOptions
    prior: CameraGeometry
    catalog: StarCatalog
    dark: NDArray[np.uint8] | NDArray[np.uint16] | None
    dark_pedestal_dn: int = 0
    hot: HotPixels = NO_HOT_PIXELS

    def options(self) -> dict[str, OptionValue]:
        """Every option of every stage, by name."""
        return {
            name: value
            for group in _OPTION_GROUPS
            for name, value in dataclasses.asdict(getattr(self, group)).items()
        }


_OPTION_GROUPS: dict[str, type[Any]] = {
    name: kind for name, kind in get_type_hints(Setup).items() if holds_options(kind)
}
OPTION_CLASSES = tuple(_OPTION_GROUPS.values())


def load_setup(values: Mapping[str, object], others: Sequence[type] = ()) -> Setup:
    """
    Checked options with prior camera, catalog and dark frame loaded.

    ``others`` are option classes of the caller whose names the mapping may hold as well.

    Raises
    ------
    OptionError
        For a name nobody knows or a bad value.
    ProductError, CatalogError
        When the prior camera or the catalog cannot be read.
    """
    known = names_of(*OPTION_CLASSES, *others)
    for name in values:
        if name not in known and not is_of_ros(name):
            raise OptionError(f'{name}: no such parameter{nearest(name, known)}')
    frames = from_mapping(SetupOptions, values)
    prior = _prior(frames)
    identification = from_mapping(IdentificationOptions, values)
    calibration = from_mapping(CalibrationOptions, values)
    check_options(calibration)
    fixed_pattern = from_mapping(FixedPatternOptions, values)
    path = Path(frames.catalog) if frames.catalog else None
    dark = _read_dark(frames.dark_frame, prior.camera.width, prior.camera.height)
    return Setup(
        frames=frames,
        attitude=from_mapping(AttitudeOptions, values),
        site=from_mapping(SiteOptions, values),
        screening=from_mapping(ScreeningOptions, values),
        fixed_pattern=fixed_pattern,
        centroid=from_mapping(CentroidOptions, values),
        identification=identification,
        calibration=calibration,
        gate=from_mapping(GateOptions, values),
        prior=prior,
        catalog=load_catalog(path, identification.magnitude_limit),
        dark=dark,
        dark_pedestal_dn=0 if dark is None else int(np.median(dark)),
        hot=hot_in_dark(dark, fixed_pattern),
    )


def _prior(frames: SetupOptions) -> CameraGeometry:
    if not frames.camera_info_url:
        raise OptionError('camera_info_url: the prior camera must be given')
    camera = read_camera_info(frames.camera_info_url)
    quaternion = np.array(frames.prior_alignment)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        raise OptionError(
            f'prior_alignment: {list(frames.prior_alignment)} is not a unit quaternion'
        )
    return CameraGeometry(camera, quaternion / norm)


def _read_dark(
    path: str, width: int, height: int
) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    if not path:
        return None
    dark = cv2.imread(path.removeprefix('file://'), cv2.IMREAD_UNCHANGED)
    if dark is None:
        raise OptionError(f'dark_frame: {path} is not an image file')
    if dark.shape != (height, width) or dark.dtype not in (np.uint8, np.uint16):
        raise OptionError(
            f'dark_frame: {path} is {dark.dtype} of shape {dark.shape}, '
            f'not one channel of {width} x {height}'
        )
    return dark.astype(np.uint8) if dark.dtype == np.uint8 else dark.astype(np.uint16)
