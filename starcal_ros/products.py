"""
The products of a calibration: ``calibration.json`` and ``camera_info.yaml``, both ways.

Numbers are written with the shortest digits that read back to the same double, so a calibration
that was written and read is equal to the last bit.  Files are replaced whole or not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
import dataclasses
import json
import math
import os
from pathlib import Path
import re
from typing import TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
import yaml

from starcal_ros.camera import CameraModel, DISTORTION_NAMES, INTRINSIC_NAMES, zero_skew_fit
from starcal_ros.errors import ProductError
from starcal_ros.records import (
    Calibration,
    CALIBRATION_PARAMETER_NAMES,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    Halves,
    Removal,
    Thermal,
)

Floats = NDArray[np.float64]
T = TypeVar('T')

SCHEMA = 1
# Keys that came after the first files were written, and what their absence means.
_LATER_KEYS: Mapping[str, object] = {
    'temperature': None,
    'maps': None,
    'correlation': None,
    'removals': [],
    'first_image_ns': 0,
    'number': 0,
    'in_force_since_ns': 0,
    'forced': False,
    'halves': None,
}
CALIBRATION_FILE = 'calibration.json'
CAMERA_INFO_FILE = 'camera_info.yaml'

PART = '.part'  # ends the name of a file that is not whole yet

# plumb_bob's order of coefficients, by our names; ROS puts k3 last.
_PLUMB_BOB = ('k1', 'k2', 'p1', 'p2', 'k3')


def write_calibration(calibration: Calibration, path: Path) -> None:
    """
    Write ``calibration.json``.

    A number that is not finite is written as null, since JSON has no other word for it, and reads
    back as NaN.

    Raises
    ------
    ProductError
        When the file cannot be written.
    """
    text = json.dumps(calibration_content(calibration), indent=1, allow_nan=False)
    # A row of a grid on a line; within a text there is no line break to be taken for one of these.
    text = re.sub(r'\[\n([^][{}"]+)\n *\]', lambda row: f'[{" ".join(row[1].split())}]', text)
    write_atomically(path, text + '\n')


def read_calibration(path: Path) -> Calibration:
    """
    The calibration in a ``calibration.json``, equal to the one that was written.

    Raises
    ------
    ProductError
        Naming the file and the key that is missing or wrong.
    """
    try:
        content = json.loads(_read_text(path))
    except ValueError as error:
        raise ProductError(f'{path}: not JSON: {error}') from error
    if not isinstance(content, dict):
        raise ProductError(f'{path}: not a calibration (no JSON object)')
    return calibration_from_content(path, content)


def calibration_from_content(path: Path, content: Mapping[str, object]) -> Calibration:
    """
    The calibration in the JSON object of a ``calibration.json``; further keys are passed over.

    Raises
    ------
    ProductError
        Naming the file ``path`` and the key that is missing or wrong.
    """
    if 'schema' not in content:
        raise ProductError(f'{path}: not a calibration (no key schema)')
    if content['schema'] != SCHEMA:
        raise ProductError(f'{path}: schema {content["schema"]!r} is not {SCHEMA}')
    try:
        return _calibration_from(_Reader(path, {**_LATER_KEYS, **content}))
    except ValueError as error:  # CameraModel's own checks
        raise ProductError(f'{path}: {error}') from error


def prior_of(calibration: Calibration) -> CameraGeometry | None:
    """Camera and alignment that a calibration started from; None where it does not tell."""
    try:
        numbers = np.array(json.loads(calibration.provenance['prior']), np.float64)
        camera = calibration.geometry.camera
        return CameraGeometry(
            CameraModel(camera.width, camera.height, numbers[:10]), numbers[10:14]
        )
    except (KeyError, ValueError, TypeError):
        return None


def write_camera_info(camera: CameraModel, path: Path, camera_name: str = 'camera') -> None:
    """
    Write a ROS camera YAML as camera_info_manager reads it, with the zero-skew fit of the camera.

    Readers of ``CameraInfo`` ignore K[0,1] without a word, so it is 0 and the other parameters
    make up for it as well as they can (`zero_skew_fit`).

    Raises
    ------
    ProductError
        When the file cannot be written.
    """
    fitted, _ = zero_skew_fit(camera)
    fx, _, fy, cx, cy = fitted.intrinsics.tolist()
    distortion = dict(zip(DISTORTION_NAMES, fitted.distortion.tolist(), strict=True))
    content = {
        'image_width': fitted.width,
        'image_height': fitted.height,
        'camera_name': camera_name,
        'camera_matrix': _matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': _matrix(1, 5, [distortion[name] for name in _PLUMB_BOB]),
        'rectification_matrix': _matrix(3, 3, np.eye(3).ravel().tolist()),
        'projection_matrix': _matrix(
            3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        ),
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=10_000)
    write_atomically(path, text)


def read_camera_info(location: str | Path) -> CameraModel:
    """
    The camera in a ROS camera YAML; K[0,1], where a file has one, is its skew.

    Parameters
    ----------
    location : str or Path
        A path, or a ``file://`` or ``package://`` URL.

    Raises
    ------
    ProductError
        Naming the file and the key that is missing, wrong or not supported.
    """
    path = resolve_url(location) if isinstance(location, str) else location
    try:
        content = yaml.safe_load(_read_text(path))
    except yaml.YAMLError as error:
        raise ProductError(f'{path}: not YAML: {" ".join(str(error).split())}') from error
    if not isinstance(content, dict):
        raise ProductError(f'{path}: not a camera YAML (no keys)')
    reader = _Reader(path, content)
    width, height = (reader.get(f'image_{side}', _whole) for side in ('width', 'height'))
    K = reader.get('camera_matrix.data', _numbers(9))
    fx, skew, cx, zero, fy, cy = K[:6]
    if zero != 0.0 or K[6:] != [0.0, 0.0, 1.0]:
        raise ProductError(f'{path}: camera_matrix.data: {K} is not [fx s cx 0 fy cy 0 0 1]')
    model = content.get('distortion_model', 'plumb_bob')
    if model != 'plumb_bob':
        raise ProductError(f'{path}: distortion_model: {model!r} is not plumb_bob')
    D = reader.get('distortion_coefficients.data', _numbers(4, 5))
    distortion = dict(zip(_PLUMB_BOB, [*D, 0.0][:5], strict=True))
    parameters = [fx, skew, fy, cx, cy, *(distortion[name] for name in DISTORTION_NAMES)]
    try:
        return CameraModel(width, height, np.array(parameters))
    except ValueError as error:
        raise ProductError(f'{path}: {error}') from error


def resolve_url(url: str) -> Path:
    """
    The path that a ``file://`` or ``package://`` URL, or a plain path, names.

    Packages are looked for as ament does, in ``share/<package>`` of each prefix of
    AMENT_PREFIX_PATH, but without ROS.

    Raises
    ------
    ProductError
        For another scheme, an empty URL or a package that no prefix has.
    """
    scheme, separator, rest = url.partition('://')
    if not separator:
        if not url:
            raise ProductError('the camera YAML is not named (empty URL)')
        return Path(url)
    if scheme == 'file':
        return _as_written_or_decoded(Path(rest))
    if scheme != 'package':
        raise ProductError(f'{url}: only file:// and package:// URLs can be read')
    package, _, inside = rest.partition('/')
    if not re.fullmatch(r'\w+', package) or not inside:
        raise ProductError(f'{url}: not package://<package>/<path>')
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        share = Path(prefix, 'share', package)
        if prefix and share.is_dir():
            return _as_written_or_decoded(share / inside)
    raise ProductError(f'{url}: package {package} is not in AMENT_PREFIX_PATH')


def with_camera_url_from(values: Mapping[str, object], params: Path) -> dict[str, object]:
    """Parameters of a file; a `camera_info_url` that is no URL is relative to that file."""
    url = values.get('camera_info_url')
    if isinstance(url, str) and url and '://' not in url:
        return {**values, 'camera_info_url': str(params.parent / url)}
    return dict(values)


def _as_written_or_decoded(path: Path) -> Path:
    """The path; ROS does not decode %20 in its URLs but others do, so both are taken."""
    return path if path.exists() else Path(unquote(str(path)))


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    Replace a file whole: readers, and a power loss, see the old one or the new one.

    Raises
    ------
    ProductError
        When the file cannot be written; the old one then stands as it was.
    """
    part = path.with_name(f'.{path.name}.{os.getpid()}{PART}')
    try:
        with part.open('wb') as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise ProductError(f'{path}: cannot be written: {error.strerror}') from error


def sync_folder(folder: Path) -> None:
    """Have the names in a folder, new and gone, outlast a power loss; raises OSError."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def calibration_content(calibration: Calibration) -> dict[str, object]:
    """The JSON object of a calibration: the interface document's keys, then this package's."""
    geometry, camera = calibration.geometry, calibration.geometry.camera
    covariance = _json_rows(calibration.covariance)
    intrinsics, distortion = _json_row(camera.intrinsics), _json_row(camera.distortion)
    return {
        'schema': SCHEMA,
        'intrinsics': dict(zip(INTRINSIC_NAMES, intrinsics, strict=True)),
        'distortion': dict(zip(DISTORTION_NAMES, distortion, strict=True)),
        'alignment': {
            'parent': calibration.parent_frame,
            'child': calibration.child_frame,
            'quaternion_xyzw': _json_row(geometry.star_tracker_from_camera_xyzw),
        },
        'parameter_names': list(CALIBRATION_PARAMETER_NAMES),
        'covariance': covariance,
        'alignment_covariance_rad2': [row[10:] for row in covariance[10:]],
        'method': calibration.method,
        'estimated': list(calibration.estimated),
        'residual_rms_px': _json_number(calibration.residual_rms_px),
        'images_used': int(calibration.images_used),
        'images_refused': {k: int(n) for k, n in calibration.images_refused.items()},
        'stars_used': int(calibration.stars_used),
        'stars_rejected': int(calibration.stars_rejected),
        'accepted': bool(calibration.accepted),
        'reasons': list(calibration.reasons),
        'provenance': dict(calibration.provenance),
        'time_ns': int(calibration.time_ns),
        'image': {'width': camera.width, 'height': camera.height},
        'variance_factor': _json_number(calibration.variance_factor),
        'alignment_scatter_arcsec': _json_number(calibration.alignment_scatter_arcsec),
        'star_tracker_sigma_arcsec': [
            _json_number(s) for s in calibration.star_tracker_sigma_arcsec
        ],
        'centroid_scale': _json_number(calibration.centroid_scale),
        'centroid_floor_px': _json_number(calibration.centroid_floor_px),
        'dropped_catalog_ids': [int(i) for i in calibration.dropped_catalog_ids],
        'misfit_images_ns': [int(t) for t in calibration.misfit_images_ns],
        'singular_values': [_json_number(s) for s in calibration.singular_values],
        'weakest_direction': calibration.weakest_direction,
        'zero_skew_cost_px': _json_number(calibration.zero_skew_cost_px),
        'iterations': int(calibration.iterations),
        'termination': calibration.termination,
        'temperature': _thermal_content(calibration.thermal),
        'maps': _maps_content(calibration.maps),
        'correlation': _correlation_content(calibration.correlation),
        'removals': [_removal_content(removal) for removal in calibration.removals],
        'first_image_ns': int(calibration.first_image_ns),
        'number': int(calibration.number),
        'in_force_since_ns': int(calibration.in_force_since_ns),
        'forced': bool(calibration.forced),
        'halves': None
        if calibration.halves is None
        else {k: _json_number(v) for k, v in dataclasses.asdict(calibration.halves).items()},
    }


def _maps_content(maps: DetectorMaps | None) -> dict[str, object] | None:
    if maps is None:
        return None
    return {
        'stars': maps.stars.tolist(),
        'line_of_sight_sigma_arcsec': _json_rows(maps.line_of_sight_sigma_arcsec),
        'shape_sigma_arcsec': _json_rows(maps.shape_sigma_arcsec),
    }


def _removal_content(removal: Removal) -> dict[str, object]:
    return {
        'removed': removal.removed,
        'significance': _json_number(removal.significance),
        'wald': _json_number(removal.wald),
        'chi2_rise': _json_number(removal.chi2_rise),
        'within_chance': bool(removal.within_chance),
        'residual_rms_px': _json_number(removal.residual_rms_px),
        'residual_std_px': [_json_number(std) for std in removal.residual_std_px],
        'map_change_px': _json_number(removal.map_change_px),
    }


def _correlation_content(correlation: Correlation | None) -> dict[str, object] | None:
    if correlation is None:
        return None
    return {'names': list(correlation.names), 'matrix': _json_rows(correlation.matrix)}


def _thermal_content(thermal: Thermal | None) -> dict[str, object] | None:
    if thermal is None:
        return None
    return {
        'reference_degc': _json_number(thermal.reference_degc),
        'focal_per_degc': [_json_number(a) for a in thermal.focal_per_degc],
        'focal_per_degc_sigma': [_json_number(s) for s in thermal.focal_sigma],
        'alignment_rate_rad_per_degc': [
            _json_number(b) for b in thermal.alignment_rate_rad_per_degc
        ],
        'alignment_rate_rad_per_degc_sigma': [
            _json_number(s) for s in thermal.alignment_rate_sigma
        ],
        'note': thermal.note,
    }


def _calibration_from(reader: _Reader) -> Calibration:
    """The record of a JSON object; `alignment_covariance_rad2` repeats a block and is not read."""
    names = reader.get('parameter_names', _texts)
    if names != CALIBRATION_PARAMETER_NAMES:
        expected = ', '.join(CALIBRATION_PARAMETER_NAMES)
        raise ProductError(f'{reader.path}: parameter_names are not {expected}')
    parameters = [
        *(reader.get(f'intrinsics.{name}', _number) for name in INTRINSIC_NAMES),
        *(reader.get(f'distortion.{name}', _number) for name in DISTORTION_NAMES),
    ]
    width, height = (reader.get(f'image.{side}', _whole) for side in ('width', 'height'))
    count = len(CALIBRATION_PARAMETER_NAMES)
    covariance = np.array(reader.get('covariance', _list_of(_numbers(count, null=True))))
    if covariance.shape != (count, count):
        raise ProductError(f'{reader.path}: covariance is not {count} x {count}')
    quaternion = np.array(reader.get('alignment.quaternion_xyzw', _numbers(4)))
    return Calibration(
        time_ns=reader.get('time_ns', _whole),
        geometry=CameraGeometry(CameraModel(width, height, np.array(parameters)), quaternion),
        covariance=covariance,
        method=reader.get('method', _text),
        estimated=reader.get('estimated', _texts),
        residual_rms_px=reader.get('residual_rms_px', _number_or_null),
        variance_factor=reader.get('variance_factor', _number_or_null),
        images_used=reader.get('images_used', _whole),
        images_refused=reader.get('images_refused', _mapping_of(_whole)),
        stars_used=reader.get('stars_used', _whole),
        stars_rejected=reader.get('stars_rejected', _whole),
        alignment_scatter_arcsec=reader.get('alignment_scatter_arcsec', _number_or_null),
        star_tracker_sigma_arcsec=tuple(
            reader.get('star_tracker_sigma_arcsec', _numbers(3, null=True))
        ),
        centroid_scale=reader.get('centroid_scale', _number_or_null),
        centroid_floor_px=reader.get('centroid_floor_px', _number_or_null),
        dropped_catalog_ids=tuple(reader.get('dropped_catalog_ids', _list_of(_whole))),
        misfit_images_ns=tuple(reader.get('misfit_images_ns', _list_of(_whole))),
        singular_values=tuple(reader.get('singular_values', _list_of(_number_or_null))),
        weakest_direction=reader.get('weakest_direction', _text),
        zero_skew_cost_px=reader.get('zero_skew_cost_px', _number_or_null),
        iterations=reader.get('iterations', _whole),
        termination=reader.get('termination', _text),
        accepted=reader.get('accepted', _true_or_false),
        reasons=reader.get('reasons', _texts),
        parent_frame=reader.get('alignment.parent', _text),
        child_frame=reader.get('alignment.child', _text),
        provenance=reader.get('provenance', _mapping_of(_text)),
        thermal=None if reader.get('temperature', _is_null) else _thermal_from(reader),
        maps=None if reader.get('maps', _is_null) else _maps_from(reader),
        correlation=None if reader.get('correlation', _is_null) else _correlation_from(reader),
        removals=_removals_from(reader),
        first_image_ns=reader.get('first_image_ns', _whole),
        number=reader.get('number', _whole),
        in_force_since_ns=reader.get('in_force_since_ns', _whole),
        forced=reader.get('forced', _true_or_false),
        halves=None
        if reader.get('halves', _is_null)
        else Halves(
            **{
                field.name: reader.get(f'halves.{field.name}', _number_or_null)
                for field in dataclasses.fields(Halves)
            }
        ),
    )


def _maps_from(reader: _Reader) -> DetectorMaps:
    return DetectorMaps(
        np.array(reader.get('maps.stars', _grid_of(_whole)), np.int64),
        np.array(reader.get('maps.line_of_sight_sigma_arcsec', _grid_of(_number_or_null))),
        np.array(reader.get('maps.shape_sigma_arcsec', _grid_of(_number_or_null))),
    )


def _removals_from(reader: _Reader) -> tuple[Removal, ...]:
    removals = []
    for removal in reader.get('removals', _list_of(_mapping_of(_as_it_is))):
        one = _Reader(reader.path, {'removals': removal})
        std_u, std_v = one.get('removals.residual_std_px', _numbers(2, null=True))
        removals.append(
            Removal(
                removed=one.get('removals.removed', _text),
                significance=one.get('removals.significance', _number_or_null),
                wald=one.get('removals.wald', _number_or_null),
                chi2_rise=one.get('removals.chi2_rise', _number_or_null),
                within_chance=one.get('removals.within_chance', _true_or_false),
                residual_rms_px=one.get('removals.residual_rms_px', _number_or_null),
                residual_std_px=(std_u, std_v),
                map_change_px=one.get('removals.map_change_px', _number_or_null),
            )
        )
    return tuple(removals)


def _correlation_from(reader: _Reader) -> Correlation:
    names = reader.get('correlation.names', _texts)
    matrix = np.array(reader.get('correlation.matrix', _grid_of(_number_or_null)))
    if matrix.shape != (len(names), len(names)):
        raise ProductError(f'{reader.path}: correlation.matrix is not of the size of its names')
    return Correlation(names, matrix)


def _thermal_from(reader: _Reader) -> Thermal:
    focal = reader.get('temperature.focal_per_degc', _list_of(_number))
    rate = reader.get('temperature.alignment_rate_rad_per_degc', _numbers(0, 3))
    focal_sigma = reader.get('temperature.focal_per_degc_sigma', _numbers(len(focal), null=True))
    rate_sigma = reader.get(
        'temperature.alignment_rate_rad_per_degc_sigma', _numbers(len(rate), null=True)
    )
    return Thermal(
        reference_degc=reader.get('temperature.reference_degc', _number),
        focal_per_degc=tuple(focal),
        focal_sigma=tuple(focal_sigma),
        alignment_rate_rad_per_degc=tuple(rate),
        alignment_rate_sigma=tuple(rate_sigma),
        note=reader.get('temperature.note', _text),
    )


class _Reader:
    """Checked look-ups in a nested mapping from a file; every error names file and key."""

    def __init__(self, path: Path, content: Mapping[str, object]) -> None:
        self.path = path
        self._content = content

    def get(self, dotted_key: str, kind: Callable[[object], T]) -> T:
        """Value at a key, as `kind` returns it; `kind` raises ValueError('what is expected')."""
        value: object = self._content
        for key in dotted_key.split('.'):
            if not isinstance(value, dict) or key not in value:
                raise ProductError(f'{self.path}: key {dotted_key!r} is missing')
            value = value[key]
        try:
            return kind(value)
        except ValueError as error:
            shown = repr(value)
            shown = shown if len(shown) <= 60 else shown[:57] + '...'
            raise ProductError(f'{self.path}: {dotted_key}: {shown} is not {error}') from error


def _number(value: object) -> float:
    """A finite number; a text too, since YAML 1.1 takes ``1e-5`` without a point for one."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError('a number')
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise ValueError('a number') from None
    if not math.isfinite(number):
        raise ValueError('a finite number')
    return number


def _number_or_null(value: object) -> float:
    return math.nan if value is None else _number(value)


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError('a whole number')
    return value


def _as_it_is(value: object) -> object:
    return value


def _is_null(value: object) -> bool:
    return value is None


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError('a text')
    return value


def _true_or_false(value: object) -> bool:
    if not isinstance(value, bool):
        raise ValueError('true or false')
    return value


def _list_of(kind: Callable[[object], T]) -> Callable[[object], list[T]]:
    def items(value: object) -> list[T]:
        if not isinstance(value, list):
            raise ValueError('a list')
        return [kind(item) for item in value]

    return items


def _grid_of(kind: Callable[[object], T]) -> Callable[[object], list[list[T]]]:
    def grid(value: object) -> list[list[T]]:
        rows = _list_of(_list_of(kind))(value)
        if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
            raise ValueError('a grid of rows alike')
        return rows

    return grid


def _texts(value: object) -> tuple[str, ...]:
    return tuple(_list_of(_text)(value))


def _numbers(*counts: int, null: bool = False) -> Callable[[object], list[float]]:
    def numbers(value: object) -> list[float]:
        items = _list_of(_number_or_null if null else _number)(value)
        if len(items) not in counts:
            raise ValueError(' or '.join(map(str, counts)) + ' numbers')
        return items

    return numbers


def _mapping_of(kind: Callable[[object], T]) -> Callable[[object], dict[str, T]]:
    def mapping(value: object) -> dict[str, T]:
        if not isinstance(value, dict):
            raise ValueError('a mapping')
        return {_text(key): kind(item) for key, item in value.items()}

    return mapping


def _json_number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _json_row(values: Floats) -> list[float | None]:
    return [_json_number(value) for value in np.asarray(values).tolist()]


def _json_rows(values: Floats) -> list[list[float | None]]:
    return [_json_row(row) for row in values]


def _matrix(rows: int, cols: int, data: list[float]) -> dict[str, object]:
    return {'rows': rows, 'cols': cols, 'data': data}


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding='utf-8')
    except OSError as error:
        raise ProductError(f'{path}: cannot be read: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise ProductError(f'{path}: not a text file') from error
