# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Setup of a calibration: options of every stage, with the files they name loaded.

The files are the prior camera, the catalog, and dark frame, flat field and bad pixels.

Implausible options raise `OptionError` in one line that names the likely mistake and its remedy,
wherever a setup is loaded: by a node at its start, by `starcal calibrate` and `diagnose`.

The options that only the nodes use are declared here too: one parameter file serves nodes and
tool, and the tool must distinguish a parameter of a node from a misspelt name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
import os
from pathlib import Path
import re
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros import options
from starcal_ros.arrays import Floats
from starcal_ros.assessment.gate import GateOptions
from starcal_ros.assessment.requirements import requirements_of
from starcal_ros.camera import CameraModel
from starcal_ros.camera.lens import LENSES
from starcal_ros.camera.projection import convert
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.options import (
    assumed_tracker_sigma_rad,
    CalibrationOptions,
    check_options,
)
from starcal_ros.formats.messages.sensor_messages import CHANNELS
from starcal_ros.formats.products import camera_yaml
from starcal_ros.identification.star_finder import IdentificationOptions, StarSearch
from starcal_ros.options import option
from starcal_ros.pipeline.detector_frames import DetectorFrames, NO_FRAMES, read_detector_frames
from starcal_ros.records import CameraGeometry, FOUND
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.attitude import AttitudeOptions, Mounting
from starcal_ros.sky.catalog import BUNDLED_MAGNITUDE, load_catalog, StarCatalog
from starcal_ros.stars.frame_checks import ScreeningOptions
from starcal_ros.stars.image_model import CentroidOptions
from starcal_ros.text import counted
from starcal_ros.untrusted import shown

_LONGEST = 500.0  # focal length by the width: a field of 0.1 degrees
# No star tracker is as good as 0.01 arcsec: 0.001 rad are 206 arcsec, 0.01 degrees 36 arcsec.
_RADIANS_BELOW, _DEGREES_BELOW = 1e-3, 1e-2
_FEWEST_STARS = 2.0  # in a mean field: the densest fields have three times as many
_FAINTEST = 100  # stars of the catalog about which its stars are counted


def check_tracker_sigma(sigma_arcsec: Sequence[float]) -> None:
    """Raise `OptionError` for a star tracker sigma in radians or degrees."""
    largest = max(sigma_arcsec)
    if not 0.0 < largest < _DEGREES_BELOW:
        return
    unit, arcsec = ('radians', 1.0 / ARCSECOND_RAD)
    if largest >= _RADIANS_BELOW:
        unit, arcsec = ('degrees', 3600.0)
    converted = ', '.join(f'{sigma * arcsec:.3g}' for sigma in sigma_arcsec)
    raise OptionError(
        f'star_tracker_sigma_arcsec: {list(sigma_arcsec)} looks like {unit}: in arcseconds it is'
        f' [{converted}]'
    )


def check_site(site: SiteOptions) -> None:
    """Raise `OptionError` for a camera on the ground without a site."""
    if site.observer == 'ground' and not site.is_known:
        raise OptionError(
            'observer: ground needs the site: set latitude_deg, longitude_deg (east positive) and'
            ' height_m; starcal calibrate needs none'
        )


def check_site_counts(site: SiteOptions) -> None:
    """Raise `OptionError` for a statement about the observer that another one leaves unused."""
    on_ground = site.observer == 'ground'
    if not on_ground and (site.latitude_deg or site.longitude_deg):
        raise OptionError('latitude_deg, longitude_deg: a site counts with observer: ground alone')
    if on_ground and any(site.observer_velocity_m_s):
        raise OptionError(
            'observer_velocity_m_s: with observer: ground the site gives the velocity: leave it'
            ' out, and state latitude_deg and longitude_deg'
        )


def check_field_of_stars(
    catalog: StarCatalog, magnitude_limit: float, camera: CameraModel
) -> None:
    """
    Raise `OptionError` for a magnitude limit that leaves a camera without stars.

    The field is one about a faint star of the catalog: a deep catalog covers a part of the sky.
    """
    fx, _, fy = (float(value) for value in camera.intrinsics[:3])
    field_sr = min(camera.width * camera.height / (fx * fy), 4.0 * math.pi)
    faintest = catalog.direction_icrs[-_FAINTEST:]
    chord = math.sqrt(field_sr / math.pi)  # radius of a cap of this area
    inside = catalog.tree.query_ball_point(faintest, chord, return_length=True)
    in_field = max(float(inside.sum()) / max(len(faintest), 1) - 1.0, 0.0)
    if in_field >= _FEWEST_STARS:
        return
    raise OptionError(
        f'magnitude_limit: {magnitude_limit:g} leaves {counted(len(catalog), "star")} in the'
        f' catalog, {in_field:.2g} in a mean field of the camera where it is deepest; raise it, or'
        ' give a deeper catalog (starcal catalog)'
    )


def check_prior_camera(camera: CameraModel, location: str) -> None:
    """Raise `OptionError` for an implausible camera that `camera.check_plausible` accepts."""
    width, height = camera.width, camera.height
    fx, _, fy, cx, cy = (float(value) for value in camera.intrinsics[:5])
    if not 0.5 < fx / fy < 2.0:
        raise OptionError(f'{location}: fx = {fx:g} and fy = {fy:g} px differ by a factor of two')
    width_deg = math.degrees(2 * math.atan(width / 2 / fx))
    if fx > _LONGEST * width:
        raise OptionError(
            f'{location}: focal length of {fx:g} px makes a field of {width_deg:.2g} degrees:'
            ' it seems to be in micrometres; divide it by the size of a pixel'
        )
    if not (-0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
        raise OptionError(
            f'{location}: principal point ({cx:g}, {cy:g}) px is far outside the image of {width}'
            f' x {height}'
        )
    if 0 < abs(cx) < 0.05 * width and 0 < abs(cy) < 0.05 * height:
        raise OptionError(
            f'{location}: principal point ({cx:g}, {cy:g}) is in the first corner of an image of'
            f' {width} x {height}: give it in pixels, not in metres or millimetres'
        )


@dataclass(frozen=True)
class SetupOptions:
    """Prior camera and alignment, frames, catalog and detector frames."""

    camera_info_url: str = option(
        '',
        'prior camera, a camera file of ROS, OpenCV, kalibr or mrcal: a path, or a file:// or'
        ' package:// URL',
        basic=True,
        is_path=True,
    )
    lens_model: str = option(
        'prior',
        'lens model to estimate; prior: the model of the prior camera; auto: the smallest model'
        ' that leaves no significant residual field, as for images without attitudes and camera'
        ' file; other models start from a fit to the prior camera',
        choices=('prior', 'auto', *LENSES),
    )
    prior_alignment: tuple[float, ...] = option(
        (0.0, 0.0, 0.0, 0.0),
        'prior orientation of the camera in the star tracker frame, a quaternion (x, y, z, w);'
        ' zeros: not given; star_observer needs it, the tool and setup_finder find it',
        length=4,
        basic=True,
    )
    star_tracker_frame: str = option('star_tracker', 'name of the star tracker frame', basic=True)
    camera_frame: str = option(
        'camera_optical_frame', 'name of the camera optical frame', basic=True
    )
    image_channel: str = option(
        '',
        'channel of rgb, bgr and bayer images to use (bayer: at half the width and height; in'
        ' image files at their size); empty: colour images are refused, of image files green is'
        ' used',
        choices=('', *CHANNELS),
    )
    catalog: str = option('', 'star catalog file; empty: the bundled catalog', is_path=True)
    dark_frame: str = option(
        '',
        'dark frame to subtract, a FITS, TIFF or PNG of the image size and depth; empty: none',
        is_path=True,
    )
    flat_field: str = option(
        '',
        'flat field to divide by, a FITS, TIFF or PNG of the image size, normalised to its'
        ' median; empty: none',
        is_path=True,
    )
    bad_pixel_map: str = option(
        '',
        'map of bad pixels, a FITS, TIFF or PNG of the image size; nonzero pixels are'
        ' treated as hot pixels; empty: none',
        is_path=True,
    )


@dataclass(frozen=True)
class Setup:
    """
    Options of every stage, with prior camera, catalog and detector frames loaded.

    Without a prior alignment ``is_aligned`` is false and ``prior`` has the identity until the
    alignment is determined.  ``origin`` has the entries of the provenance on image files and on
    parts of the prior that are a first solution of the images: `TIMES`, `PIXELS_OF`, `FOUND`, and
    those that begin with `ORIGINAL`.
    """

    frames: SetupOptions
    attitude: AttitudeOptions
    site: SiteOptions
    screening: ScreeningOptions
    centroid: CentroidOptions
    identification: IdentificationOptions
    calibration: CalibrationOptions
    gate: GateOptions
    prior: CameraGeometry
    catalog: StarCatalog
    detector: DetectorFrames = NO_FRAMES
    is_aligned: bool = True
    camera_name: str = camera_yaml.DEFAULT_CAMERA_NAME
    mountings: tuple[Mounting, ...] = ()
    origin: Mapping[str, str] = field(default_factory=dict)

    @property
    def has_tracker(self) -> bool:
        """False where the attitudes are those of the stars, each image identified by itself."""
        return bool(self.frames.star_tracker_frame)

    @property
    def star_search(self) -> StarSearch:
        """Catalog and options for the identification of the stars of an image."""
        tracker_sigma_rad = float(assumed_tracker_sigma_rad(self.calibration).max())
        return StarSearch(self.catalog, self.centroid, self.identification, tracker_sigma_rad)

    def options(self) -> dict[str, options.OptionValue]:
        """Every option of every stage, by name."""
        return {
            field.name: getattr(getattr(self, group), field.name)
            for group, kind in _OPTION_GROUPS
            for field in options.option_fields(kind)
        }


_OPTION_GROUPS: tuple[tuple[str, type[Any]], ...] = (
    ('frames', SetupOptions),
    ('attitude', AttitudeOptions),
    ('site', SiteOptions),
    ('screening', ScreeningOptions),
    ('centroid', CentroidOptions),
    ('identification', IdentificationOptions),
    ('calibration', CalibrationOptions),
    ('gate', GateOptions),
)
OPTION_CLASSES = tuple(kind for _, kind in _OPTION_GROUPS)


@dataclass(frozen=True)
class NodeOptions:
    """Options shared by the lifecycle nodes."""

    autostart: bool = option(True, 'configure and activate at start, without a lifecycle manager')


@dataclass(frozen=True)
class ObserverOptions:
    """Inputs of the star observer."""

    attitude_timeout_s: float = option(
        10.0,
        'longest wait of an image for the next attitude sample, wall clock, s; more where'
        ' telemetry brings attitudes in blocks, less to play a bag in which they drop out',
        low=0.0,
    )


@dataclass(frozen=True)
class CalibratorOptions:
    """State of the calibrator and transfer of new calibrations."""

    state_dir: str = option(
        '',
        'folder that keeps images and calibrations across restarts; empty: memory only',
        basic=True,
        is_path=True,
    )
    state_key_file: str = option(
        '',
        'file with a secret key of at least 16 bytes; state files then carry an HMAC, and files'
        ' without a valid one are set aside; empty: checksums only, which detect damage but not'
        ' forgery',
        is_path=True,
    )
    set_camera_info_service: str = option(
        '', 'sensor_msgs/SetCameraInfo service that receives each new calibration; empty: none'
    )


NODE_OPTION_CLASSES = (NodeOptions, ObserverOptions, CalibratorOptions)
"""Options that a parameter file may hold besides those of the processing stages."""


def paths_from(values: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Options whose relative paths are relative to a folder."""
    fields = options.option_fields(SetupOptions, CalibratorOptions)
    names = [field.name for field in fields if field.metadata['is_path']]
    paths = {name: values[name] for name in names if isinstance(values.get(name), str)}
    return {
        **values,
        **{
            name: str(folder / options.with_home(name, str(path)))
            for name, path in paths.items()
            if path and '://' not in str(path)
        },
    }


def files_of(frames: SetupOptions) -> dict[str, Path]:
    """
    Paths of the files named by options: prior camera, catalog and detector frames.

    Raises ProductError for a camera URL that names no file.
    """
    files = {}
    if frames.camera_info_url:
        files['camera_info_url'] = camera_yaml.resolve_url(frames.camera_info_url)
    for name in ('catalog', 'dark_frame', 'flat_field', 'bad_pixel_map'):
        if path := getattr(frames, name):
            files[name] = Path(path.removeprefix('file://'))
    return files


def _check_there(files: Mapping[str, Path]) -> None:
    """Raise OptionError for a path without a file."""
    for name, path in files.items():
        if not os.path.lexists(path):
            folder = f' in {Path.cwd()}; in a parameter file, paths are relative to that file'
            raise OptionError(
                f'{name}: {path}: no such file{"" if path.is_absolute() else folder}'
            )


def option_groups(values: Mapping[str, object]) -> dict[str, Any]:
    """
    Options of every stage, by the names of `Setup`, checked as far as that needs no camera.

    Options of the nodes are checked, too. Raises OptionError for an unknown name or a bad value.
    """
    known = options.names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
    for name in values:
        if name not in known and not options.is_of_ros(name):
            raise OptionError(options.unknown_option(name, known))
    groups: dict[str, Any] = {
        name: options.from_mapping(kind, values) for name, kind in _OPTION_GROUPS
    }
    for kind in NODE_OPTION_CLASSES:
        options.from_mapping(kind, values)  # a value that is read elsewhere is checked here too
    _check_there(files_of(groups['frames']))
    check_tracker_sigma(groups['calibration'].star_tracker_sigma_arcsec)
    check_site_counts(groups['site'])
    requirements_of(groups['gate'].requirements)
    return groups


def load_setup(values: Mapping[str, object], prior: CameraGeometry | None = None) -> Setup:
    """
    Setup from a mapping of option names to values, all checked.

    ``prior`` replaces the camera file and alignment of the options; its camera is converted to the
    stated lens model, as that of a file is. Raises OptionError for an unknown name or a bad value.
    Raises ProductError or CatalogError when the prior camera or the catalog cannot be read.
    """
    groups = option_groups(values)
    frames: SetupOptions = groups['frames']
    is_aligned = prior is not None or any(frames.prior_alignment)
    prior = _in_stated_model(frames, prior or _prior(frames))
    check_options(groups['calibration'], prior.camera.model)
    magnitude_limit = groups['identification'].magnitude_limit
    catalog = load_catalog(Path(frames.catalog) if frames.catalog else None, magnitude_limit)
    # With all of the bundled catalog the images are refused, and their sky named.
    if frames.catalog or magnitude_limit < BUNDLED_MAGNITUDE:
        check_field_of_stars(catalog, magnitude_limit, prior.camera)
    size = prior.camera.width, prior.camera.height
    return Setup(
        **groups,
        prior=prior,
        catalog=catalog,
        detector=read_detector_frames(
            frames.dark_frame, frames.flat_field, frames.bad_pixel_map, *size
        ),
        is_aligned=is_aligned,
        camera_name=camera_yaml.read_camera_name(frames.camera_info_url),
        mountings=_mountings(groups['attitude'], frames, prior, is_aligned),
    )


def aligned(setup: Setup, star_tracker_from_camera_xyzw: Floats) -> Setup:
    """A copy of a setup with the prior alignment found from the images."""
    prior = CameraGeometry(setup.prior.camera, star_tracker_from_camera_xyzw)
    found = ', '.join(filter(None, (setup.origin.get(FOUND), 'alignment')))
    return replace(setup, prior=prior, is_aligned=True, origin={**setup.origin, FOUND: found})


def with_method(setup: Setup, method: str, estimate: Sequence[str]) -> Setup:
    """
    A copy of a setup with another method and other parameters to estimate, each unless empty.

    Raises OptionError for an unknown method or parameter name.
    """
    asked = {'method': method, 'estimate': tuple(estimate)}
    changed = {name: value for name, value in asked.items() if value}
    for known in options.option_fields(CalibrationOptions):
        if known.name in changed:
            options.check_value(known, changed[known.name])
    calibration = replace(setup.calibration, **changed)  # type: ignore[arg-type]
    return replace(setup, calibration=calibration)


def _mountings(
    attitude: AttitudeOptions, setup: SetupOptions, prior: CameraGeometry, is_aligned: bool
) -> tuple[Mounting, ...]:
    """The additional star trackers in the frame of the first, from the prior alignments."""
    frames = [frame for frame in attitude.more_star_trackers if frame]
    if not frames:
        return ()
    taken = {setup.star_tracker_frame.lstrip('/'), setup.camera_frame.lstrip('/')}
    for frame in frames:
        if frame.lstrip('/') in taken:
            raise OptionError(
                f'more_star_trackers: {shown(frame)} is given twice: each of them,'
                ' star_tracker_frame and camera_frame need different names'
            )
        taken.add(frame.lstrip('/'))
        if not re.fullmatch(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', frame):
            raise OptionError(f'more_star_trackers: {shown(frame)} is not a valid frame name')
    if not is_aligned:
        raise OptionError(
            'more_star_trackers: more_alignments needs prior_alignment too: it'
            ' cannot be found from the images'
        )
    if len(attitude.more_alignments) != 4 * len(frames):
        raise OptionError(
            f'more_alignments: {len(attitude.more_alignments)} numbers, but {len(frames)} further'
            f' star trackers need {4 * len(frames)}'
        )
    rows = np.array(attitude.more_alignments).reshape(-1, 4).tolist()
    quaternions = [_unit_quaternion('more_alignments', row) for row in rows]
    first = Rotation.from_quat(prior.star_tracker_from_camera_xyzw)
    mounted = (first * Rotation.from_quat(quaternions).inv()).as_quat()
    return tuple(Mounting(*pair) for pair in zip(frames, mounted, strict=True))


def _unit_quaternion(option: str, values: Sequence[float]) -> Floats:
    quaternion = np.array(values)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        hint = '; angles in degrees are not a quaternion' if np.abs(quaternion).max() > 2.0 else ''
        raise OptionError(
            f'{option}: {list(values)} is not a unit quaternion (x, y, z, w): its norm is'
            f' {norm:.6g}{hint}'
        )
    return np.asarray(quaternion / norm)


def _prior(frames: SetupOptions) -> CameraGeometry:
    if not frames.camera_info_url:
        raise OptionError('camera_info_url: not set; give the camera YAML of the prior camera')
    camera = camera_yaml.read_camera_info(frames.camera_info_url)
    check_prior_camera(camera, frames.camera_info_url)
    if not any(frames.prior_alignment):
        return CameraGeometry(camera, np.array([0.0, 0.0, 0.0, 1.0]))
    return CameraGeometry(camera, _unit_quaternion('prior_alignment', frames.prior_alignment))


def _in_stated_model(frames: SetupOptions, prior: CameraGeometry) -> CameraGeometry:
    """A prior whose camera has the stated lens model; raises OptionError where that is no lens."""
    camera = prior.camera
    if frames.lens_model not in ('prior', 'auto', camera.model):
        camera, worst_px = convert(camera, frames.lens_model)
        if not math.isfinite(worst_px):
            raise OptionError(
                f'lens_model: {frames.lens_model} does not cover the field of the prior camera,'
                f' {frames.camera_info_url or "found by the stars"}'
            )
    return replace(prior, camera=camera)
