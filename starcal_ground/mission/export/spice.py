# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
SPICE kernels of a calibration: frame (FK), instrument (IK), attitude of each image (CK).

The FK has the camera as a fixed frame (TKFRAME) in the star tracker frame.  The IK has the field
of view, and the whole camera: lens model, skew and field; nothing is approximated.  The CK, of
type 3, has the attitude of the calibrated camera by the stars of each image, an interval of its
own, so that nothing is interpolated from one to the next; its comment area describes it.  Sources:
NAIF's Frames Required Reading (TK frames), Kernel Required Reading (text kernels), CK Required
Reading (a C-matrix takes inertial to frame coordinates), DAF Required Reading (comment area) and
the specification of GETFOV.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
import re
import tempfile
import textwrap
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.mission.export import exported
from starcal_ground.mission.export.image_attitude import attitude_by_stars
from starcal_ground.mission.export.request import Request, SpiceNames
from starcal_ground.mission.ingest.kernels import ephemeris_time, loaded, short
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.camera.detector_field import COSINE_DOMAIN
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD, utc_text
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.records import Calibration

_LONGEST_NAME = 32  # pool variables and frames: SPICE Required Reading, kernel.req, frames.req
_COMMENT_COLUMNS = 78  # longer lines are read, but NAIF asks for no more than 80
_STRING_COLUMNS = 80  # longest string value of a pool variable
_GEOMETRIC = (
    'Rotations are geometric and free of stellar aberration: the stars were placed where the'
    ' velocity of the observer (received, stated, or that of the Earth) shows them, and on the'
    " ground the air. The camera sees a target at its apparent position (abcorr 'LT+S', 'CN+S')."
)

Value = int | str | Sequence[float] | Sequence[str]
_SIDE_POINTS = 4  # vertices of the field of view on each side of the detector
_WIDEST_RAD = np.radians(89.0)  # SPICE sees no polygon wider than a half space
UM_PER_MM = 1000.0


def spice_kernels(calibration: Calibration, asked: Request) -> exported.Content:
    """
    The FK and the IK of a calibration.

    Raises OptionError for names that SPICE does not allow.
    """
    names = checked_names(asked.names)
    camera_frame = _frame_name(names.camera_frame or calibration.child_frame, '--camera-frame')
    tracker_frame = _frame_name(
        names.star_tracker_frame or calibration.parent_frame, '--star-tracker-frame'
    )
    if camera_frame == tracker_frame:
        raise OptionError(f'--camera-frame: {camera_frame} is the star tracker frame too')
    losses = exported.temperature_losses(calibration)
    boresight, corners = field_of_view(calibration.geometry.camera)
    if corners is None:
        losses = (*losses, exported.Loss('field of view: as wide as a half space or folded', 0.0))
    missing = [f'Not in this kernel: {loss.part}, {loss.cost_px:.3g} px.' for loss in losses]
    about = [*exported.origin(calibration), '', *missing]
    fk = _frame_kernel(calibration, names, camera_frame, tracker_frame, about)
    ik = _instrument_kernel(calibration, names, camera_frame, boresight, corners, about)
    return exported.Content({'camera.tf': fk, 'camera.ti': ik}, losses=losses)


def field_of_view(camera: CameraModel) -> tuple[Floats, Floats | None]:
    """
    Boresight (3,), the line of sight of the middle of the detector, and corners (n, 3).

    The corners follow the outer edge of the detector, so that a curved edge is kept; None where a
    point of the edge has no line of sight or SPICE could not take the polygon.
    """
    w, h = camera.width, camera.height
    share = np.arange(_SIDE_POINTS) / _SIDE_POINTS
    ends = np.array([[0, 0], [w, 0], [w, h], [0, h]]) - 0.5
    sides = np.roll(ends, -1, axis=0) - ends
    edge = (ends[:, None] + share[:, None] * sides[:, None]).reshape(-1, 2)
    boresight = line_of_sight(camera, np.array([(w - 1) / 2, (h - 1) / 2]))
    corners = line_of_sight(camera, edge)
    if not (corners @ boresight > np.cos(_WIDEST_RAD)).all():  # NaN is not either
        return boresight, None
    return boresight, corners


def checked_names(names: SpiceNames | None) -> SpiceNames:
    """The names of a request; raises OptionError for none, or for what SPICE does not allow."""
    if names is None:
        raise OptionError('--spacecraft-id: give the NAIF ID of the spacecraft')
    if names.spacecraft_id >= 0:
        raise OptionError(f'--spacecraft-id: {names.spacecraft_id} is not a negative NAIF ID')
    if names.instrument_id > 0:
        raise OptionError(f'--instrument-id: {names.instrument_id} is not a negative NAIF ID')
    if names.camera_id == names.star_tracker_id:
        raise OptionError(f'--star-tracker-id: {names.star_tracker_id} is the ID of the camera')
    if not 0 <= names.pixel_size_um < 1e4:
        raise OptionError(f'--pixel-size-um: {names.pixel_size_um:g} is not within 0 to 10000')
    return names


def _frame_kernel(
    calibration: Calibration,
    names: SpiceNames,
    camera_frame: str,
    tracker_frame: str,
    about: list[str],
) -> str:
    number = names.camera_id
    comments = [
        f'{camera_frame} is fixed in {tracker_frame}. TKFRAME_{number}_Q takes vectors of the',
        'camera frame to the star tracker frame (SPICE quaternion, scalar first).',
        '',
        *exported.PIXEL_CONVENTION,
        _GEOMETRIC,
        '',
        _alignment_sigma(calibration),
        f'Names of the calibration: {calibration.child_frame} in {calibration.parent_frame}.',
        '',
        *about,
    ]
    data: list[str] = []
    tracker_id, center = names.star_tracker_id, names.spacecraft_id
    if tracker_id:
        comments += ['', f'{tracker_frame} is a CK frame: its attitude is in a C kernel.']
        clock: dict[str, Value] = {f'CK_{tracker_id}_SCLK': center, f'CK_{tracker_id}_SPK': center}
        data += [*_assignments(_frame(tracker_frame, tracker_id, 3, center) | clock), '']
    else:
        comments += ['', f'{tracker_frame} must be defined by the frame kernel of the mission.']
    x, y, z, w = calibration.geometry.star_tracker_from_camera_xyzw
    fixed: dict[str, Value] = {'RELATIVE': tracker_frame, 'SPEC': 'QUATERNION', 'Q': [w, x, y, z]}
    data += _assignments(_frame(camera_frame, number, 4, center))
    data += _assignments(fixed, f'TKFRAME_{number}_')
    data += ['', f"   NAIF_BODY_NAME += '{camera_frame}'", f'   NAIF_BODY_CODE += {number}']
    return _kernel('FK', f'Frame of the camera {camera_frame}', comments, data)


def _alignment_sigma(calibration: Calibration) -> str:
    sigmas = ', '.join(f'{sigma:.3f}' for sigma in calibration.sigma[-3:] / ARCSECOND_RAD)
    return f'1-sigma of the alignment about the camera axes, arcsec: {sigmas}.'


def _frame(name: str, number: int, kind: int, center: int) -> dict[str, Value]:
    start = f'FRAME_{number}_'
    values = {f'{start}CLASS': kind, f'{start}CLASS_ID': number, f'{start}CENTER': center}
    return {f'FRAME_{name}': number, f'{start}NAME': name, **values}


def _instrument_kernel(
    calibration: Calibration,
    names: SpiceNames,
    camera_frame: str,
    boresight: Floats,
    corners: Floats | None,
    about: list[str],
) -> str:
    camera = calibration.geometry.camera
    prefix = f'INS{names.camera_id}_'
    values: dict[str, Value] = {}
    if corners is not None:
        values |= {
            'FOV_FRAME': camera_frame,
            'FOV_SHAPE': 'POLYGON',
            'FOV_CLASS_SPEC': 'CORNERS',
            'BORESIGHT': boresight.tolist(),
            'FOV_BOUNDARY_CORNERS': corners.ravel().tolist(),
        }
    values |= _lens_values(camera)
    if names.pixel_size_um:
        mm = np.sqrt(camera.intrinsics[0] * camera.intrinsics[2]) * names.pixel_size_um
        values |= {'FOCAL_LENGTH': [mm / UM_PER_MM], 'PIXEL_SIZE': [names.pixel_size_um] * 2}
    terms = calibration.temperature
    if terms is not None:
        values['REFERENCE_DEGC'] = [terms.reference_degc]
        values |= {'FOCAL_PER_DEGC': terms.focal_per_degc} if terms.focal_per_degc else {}
        rate = terms.alignment_rate_rad_per_degc
        values |= {'ALIGNMENT_PER_DEGC': rate} if rate else {}
    values['PARAMETERS'] = calibration.parameter_names
    values['PARAMETER_SIGMAS'] = calibration.sigma.tolist()
    comments = [*_lens_comments(camera, names), '', *about]
    return kernel_text(f'Camera {camera_frame}', comments, prefix, values)


_FIELD_IN_WORDS = (
    f'   P(0; x) = 1, P(n; x) = sqrt(2) cos(pi n (x / {2.0 * COSINE_DOMAIN:g} + 0.5)),',
    '   a = (2 U + 1) / PIXEL_SAMPLES - 1, b = (2 V + 1) / PIXEL_LINES - 1.',
)


def _lens_values(camera: CameraModel) -> dict[str, Value]:
    fx, skew, fy, cx, cy = camera.intrinsics.tolist()
    names = camera.parameter_names[len(camera.intrinsics) :]
    values: dict[str, Value] = {
        'PIXEL_SAMPLES': camera.width,
        'PIXEL_LINES': camera.height,
        'IFOV': [1.0 / fx, 1.0 / fy],
        'FOCAL_LENGTH_PX': [fx, fy],
        'SKEW_PX': [skew],
        'CCD_CENTER': [cx, cy],
        'LENS_MODEL': camera.model,
        'LENS_COEFFICIENTS': camera.distortion.tolist(),
        'LENS_TERMS': names,
    }
    if (field := camera.moving_field) is not None:
        orders = field.orders
        values |= {
            'FIELD_ORDERS_U': orders[:, 0].tolist(),
            'FIELD_ORDERS_V': orders[:, 1].tolist(),
            'FIELD_U_PX': field.coefficients[0].tolist(),
            'FIELD_V_PX': field.coefficients[1].tolist(),
        }
    return values


def _lens_comments(camera: CameraModel, names: SpiceNames) -> list[str]:
    lines = [
        *exported.PIXEL_CONVENTION,
        _GEOMETRIC,
        '',
        'A direction (X, Y, Z) of the camera frame is seen at pixel (u, v), with',
        'x = X/Z, y = Y/Z, r2 = x^2 + y^2, and LENS_COEFFICIENTS named by LENS_TERMS:',
        '',
        *(f'   {line}' for line in LENSES[camera.model].equations),
        "   u = FOCAL_LENGTH_PX(1) x' + SKEW_PX y' + CCD_CENTER(1)",
        "   v = FOCAL_LENGTH_PX(2) y' + CCD_CENTER(2)",
    ]
    if camera.moving_field is not None:
        lines += [
            '',
            'A star that these equations place at (u, v) is measured at (U, V) with',
            '   U = u + f_u(U, V), V = v + f_v(U, V)',
            'where f is the sum over k of FIELD_U_PX(k) (FIELD_V_PX(k)) times',
            '   P(i; a) P(j; b), i = FIELD_ORDERS_U(k), j = FIELD_ORDERS_V(k), and',
            *_FIELD_IN_WORDS,
            'Beyond the detector f is that at its edge.',
        ]
    if names.pixel_size_um:
        lines += ['', 'FOCAL_LENGTH is in mm, PIXEL_SIZE in micrometres (as given on export).']
    return [
        *lines,
        '',
        'BORESIGHT is the line of sight of the middle of the detector.',
        'PARAMETER_SIGMAS are the 1-sigma of PARAMETERS: px, for alignment angles rad.',
    ]


def kernel_text(
    title: str, comments: Iterable[str], prefix: str, values: Mapping[str, Value]
) -> str:
    """Text of an IK with comments and assignments."""
    return _kernel('IK', title, comments, _assignments(values, prefix))


def _kernel(kind: str, title: str, comments: Iterable[str], data: Iterable[str]) -> str:
    """Text of a kernel of a kind (``FK``, ``IK``): title, comments, assignments."""
    lines = [f'KPL/{kind}', '', *_titled(title, comments)]
    lines += ['', r'\begindata', '', *data, '', r'\begintext', '']
    return '\n'.join(lines)


def _titled(title: str, comments: Iterable[str]) -> list[str]:
    """Lines of comments under a title."""
    return [title, '-' * len(title), '', *(line for text in comments for line in _wrapped(text))]


def _assignments(values: Mapping[str, Value], prefix: str = '') -> list[str]:
    """
    Lines that give pool variables a whole number, a string, or a list of numbers or strings.

    Floating-point numbers have all digits; SPICE's reader may be off by two in the last bit.
    Raises OptionError when a name is longer than SPICE allows: the identifier in it has too many
    digits.
    """
    lines = []
    for key, value in values.items():
        name = prefix + key
        if len(name) > _LONGEST_NAME:
            raise OptionError(f'{name}: over {_LONGEST_NAME} characters, use a shorter NAIF ID')
        if isinstance(value, (int, str)):
            lines.append(f'   {name} = {_quoted(value) if isinstance(value, str) else value}')
            continue
        items = [_quoted(item) if isinstance(item, str) else repr(float(item)) for item in value]
        lines += [f'   {name} = (', *(f'      {item}' for item in items), '   )']
    return lines


def _frame_name(text: str, option: str) -> str:
    """
    A frame name as SPICE takes it: upper case, letters, digits and underscores.

    Raises OptionError when nothing is left, or more than SPICE allows; the text names the option.
    """
    name = re.sub(r'[^A-Z0-9_]+', '_', text.upper()).strip('_')
    if not name or len(name) > _LONGEST_NAME:
        raise OptionError(
            f'{option}: {text!r} makes no frame name of 1 to {_LONGEST_NAME} characters'
        )
    return name


def _quoted(text: str) -> str:
    return "'" + exported.ascii_line(text)[:_STRING_COLUMNS].replace("'", "''") + "'"


def _wrapped(text: str) -> list[str]:
    # Only the first blanks of a line are its indent; a backslash would open a data block.
    text = exported.ascii_line(text.replace('\\', '/'))
    indent = ' ' * (len(text) - len(text.lstrip()))
    below = indent + '  '
    return textwrap.wrap(
        text, _COMMENT_COLUMNS, subsequent_indent=below, break_on_hyphens=False
    ) or ['']


CK_FILE = 'camera.bc'
_INTERNAL_NAME = 'starcal: attitude of the calibrated camera'


def ck_of_images(calibration: Calibration, asked: Request) -> exported.Content:
    """
    A CK of the attitudes of images.

    With a star tracker ID they are of its frame, in which the frame kernel of `spice_kernels` has
    the camera; else of the camera itself, by its instrument ID.  Raises ProductError if no image
    has stars, or SPICE refuses the file.  Raises OptionError without kernels, IngestError for one
    that cannot be read.
    """
    names = checked_names(asked.names)
    if not asked.kernels:
        raise OptionError(
            '--kernels: give the leap seconds kernel (naif*.tls) and the clock kernel (.tsc) of'
            ' the spacecraft, which --to ck needs'
        )
    attitudes = {
        image.time_ns: attitude
        for image in asked.observations
        if (attitude := attitude_by_stars(calibration, image)) is not None
    }
    if not attitudes:
        raise ProductError('--to ck: no image with stars among the observations')
    times_ns = sorted(attitudes)
    icrf_from_frame = Rotation.concatenate(
        [attitudes[time_ns].icrf_from_camera for time_ns in times_ns]
    )
    if names.star_tracker_id:
        icrf_from_frame = icrf_from_frame * calibration.geometry.star_tracker_from_camera.inv()
    structure = names.star_tracker_id or names.camera_id
    sigma_px = float(np.median([one.sigma_px for one in attitudes.values()]))
    comments = _ck_comments(calibration, names, times_ns, sigma_px)
    q = np.roll(icrf_from_frame.inv().as_quat(), 1, axis=1)
    with loaded(asked.kernels) as spice:
        try:
            ticks = np.array(
                [spice.sce2c(names.spacecraft_id, ephemeris_time(spice, t)) for t in times_ns]
            )
            data = _ck(spice, structure, ticks, q, comments)
        except spice.SpiceyError as error:
            raise ProductError(f'{CK_FILE}: {short(error)}') from error
    loss = exported.Loss('1-sigma of the attitude of an image (median)', sigma_px)
    return exported.Content({CK_FILE: data}, losses=(loss,))


def _ck_comments(
    calibration: Calibration, names: SpiceNames, times_ns: Sequence[int], sigma_px: float
) -> list[str]:
    """Comment area of a CK of the attitudes of images at some times."""
    camera = calibration.geometry.camera
    sigma_arcsec = sigma_px / camera.parameters[0] / ARCSECOND_RAD
    frame = f'{names.camera_id}, the camera'
    by_alignment: list[str] = []
    if names.star_tracker_id:
        frame = f'{names.star_tracker_id}, the star tracker, by the alignment of the camera'
        by_alignment = [_alignment_sigma(calibration)]
    span = f'{utc_text(times_ns[0])} to {utc_text(times_ns[-1])}'
    comments = [
        f'C-matrices take vectors of J2000 (axes of the ICRF) to frame {frame}.',
        f'{len(times_ns)} images, {span}, at the middle of their exposures.',
        'Type 3, an interval for each image: nothing is interpolated.',
        'Estimated: a rotation for each image, from its stars and the calibrated camera alone.',
        f'Median 1-sigma across the boresight: {sigma_px:.3g} px, {sigma_arcsec:.3g} arcsec.',
        *by_alignment,
        _GEOMETRIC,
        '',
        *exported.origin(calibration),
    ]
    return _titled('Attitude of a calibrated camera at each image, by its stars', comments)


def _ck(spice: Any, structure: int, ticks: Floats, q: Floats, comments: list[str]) -> bytes:
    """Content of a CK with an interval for each attitude, and its comment area."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'attitude.bc')
        handle = spice.ckopn(str(path), _INTERNAL_NAME, len('\n'.join(comments)))
        spice.dafac(handle, comments)
        no_rate = np.zeros((len(ticks), 3))
        spice.ckw03(
            *(handle, ticks[0], ticks[-1], structure, 'J2000', False, 'starcal', len(ticks)),
            *(ticks, q, no_rate, len(ticks), ticks),
        )
        spice.ckcls(handle)
        return path.read_bytes()
