"""
The file of a calibration, ``calibration.json``, both ways.

Numbers are written with the shortest digits that read back to the same double, so a calibration
that was written and read is equal to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import json
import math
from pathlib import Path
import re

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, DISTORTION_NAMES, INTRINSIC_NAMES
from starcal_ros.errors import ProductError
from starcal_ros.products.fields import (
    anything,
    CheckedValues,
    finite_number,
    finite_or_null,
    grid_of,
    is_null,
    list_of,
    mapping_of,
    row_of_numbers,
    string,
    strings,
    true_or_false,
    whole_number,
)
from starcal_ros.products.files import read_text, write_atomically
from starcal_ros.records import (
    Calibration,
    CALIBRATION_PARAMETER_NAMES,
    CameraGeometry,
    Correlation,
    DetectorMaps,
    GateCheck,
    Halves,
    Removal,
    Thermal,
)

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
    'gate': [],
}
CALIBRATION_FILE = 'calibration.json'


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
        content = json.loads(read_text(path))
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
        return _calibration_from(CheckedValues(path, {**_LATER_KEYS, **content}))
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
        'gate': [_check_content(check) for check in calibration.gate],
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


def _check_content(check: GateCheck) -> dict[str, object]:
    return {
        'name': check.name,
        'option': check.option,
        'found': _json_number(check.found),
        'limit': _json_number(check.limit),
        'unit': check.unit,
        'kept': check.kept,
        'note': check.note,
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


def _calibration_from(reader: CheckedValues) -> Calibration:
    """The record of a JSON object; `alignment_covariance_rad2` repeats a block and is not read."""
    names = reader.get('parameter_names', strings)
    if names != CALIBRATION_PARAMETER_NAMES:
        expected = ', '.join(CALIBRATION_PARAMETER_NAMES)
        raise ProductError(f'{reader.path}: parameter_names are not {expected}')
    parameters = [
        *(reader.get(f'intrinsics.{name}', finite_number) for name in INTRINSIC_NAMES),
        *(reader.get(f'distortion.{name}', finite_number) for name in DISTORTION_NAMES),
    ]
    width, height = (reader.get(f'image.{side}', whole_number) for side in ('width', 'height'))
    count = len(CALIBRATION_PARAMETER_NAMES)
    covariance = np.array(reader.get('covariance', list_of(row_of_numbers(count, null=True))))
    if covariance.shape != (count, count):
        raise ProductError(f'{reader.path}: covariance is not {count} x {count}')
    quaternion = np.array(reader.get('alignment.quaternion_xyzw', row_of_numbers(4)))
    return Calibration(
        time_ns=reader.get('time_ns', whole_number),
        geometry=CameraGeometry(CameraModel(width, height, np.array(parameters)), quaternion),
        covariance=covariance,
        method=reader.get('method', string),
        estimated=reader.get('estimated', strings),
        residual_rms_px=reader.get('residual_rms_px', finite_or_null),
        variance_factor=reader.get('variance_factor', finite_or_null),
        images_used=reader.get('images_used', whole_number),
        images_refused=reader.get('images_refused', mapping_of(whole_number)),
        stars_used=reader.get('stars_used', whole_number),
        stars_rejected=reader.get('stars_rejected', whole_number),
        alignment_scatter_arcsec=reader.get('alignment_scatter_arcsec', finite_or_null),
        star_tracker_sigma_arcsec=tuple(
            reader.get('star_tracker_sigma_arcsec', row_of_numbers(3, null=True))
        ),
        centroid_scale=reader.get('centroid_scale', finite_or_null),
        centroid_floor_px=reader.get('centroid_floor_px', finite_or_null),
        dropped_catalog_ids=tuple(reader.get('dropped_catalog_ids', list_of(whole_number))),
        misfit_images_ns=tuple(reader.get('misfit_images_ns', list_of(whole_number))),
        singular_values=tuple(reader.get('singular_values', list_of(finite_or_null))),
        weakest_direction=reader.get('weakest_direction', string),
        zero_skew_cost_px=reader.get('zero_skew_cost_px', finite_or_null),
        iterations=reader.get('iterations', whole_number),
        termination=reader.get('termination', string),
        accepted=reader.get('accepted', true_or_false),
        reasons=reader.get('reasons', strings),
        parent_frame=reader.get('alignment.parent', string),
        child_frame=reader.get('alignment.child', string),
        provenance=reader.get('provenance', mapping_of(string)),
        thermal=None if reader.get('temperature', is_null) else _thermal_from(reader),
        maps=None if reader.get('maps', is_null) else _maps_from(reader),
        correlation=None if reader.get('correlation', is_null) else _correlation_from(reader),
        removals=_removals_from(reader),
        first_image_ns=reader.get('first_image_ns', whole_number),
        number=reader.get('number', whole_number),
        in_force_since_ns=reader.get('in_force_since_ns', whole_number),
        forced=reader.get('forced', true_or_false),
        halves=None
        if reader.get('halves', is_null)
        else Halves(
            **{
                field.name: reader.get(f'halves.{field.name}', finite_or_null)
                for field in dataclasses.fields(Halves)
            }
        ),
        gate=_checks_from(reader),
    )


def _maps_from(reader: CheckedValues) -> DetectorMaps:
    return DetectorMaps(
        np.array(reader.get('maps.stars', grid_of(whole_number)), np.int64),
        np.array(reader.get('maps.line_of_sight_sigma_arcsec', grid_of(finite_or_null))),
        np.array(reader.get('maps.shape_sigma_arcsec', grid_of(finite_or_null))),
    )


def _removals_from(reader: CheckedValues) -> tuple[Removal, ...]:
    removals = []
    for removal in reader.get('removals', list_of(mapping_of(anything))):
        one = CheckedValues(reader.path, {'removals': removal})
        std_u, std_v = one.get('removals.residual_std_px', row_of_numbers(2, null=True))
        removals.append(
            Removal(
                removed=one.get('removals.removed', string),
                significance=one.get('removals.significance', finite_or_null),
                wald=one.get('removals.wald', finite_or_null),
                chi2_rise=one.get('removals.chi2_rise', finite_or_null),
                within_chance=one.get('removals.within_chance', true_or_false),
                residual_rms_px=one.get('removals.residual_rms_px', finite_or_null),
                residual_std_px=(std_u, std_v),
                map_change_px=one.get('removals.map_change_px', finite_or_null),
            )
        )
    return tuple(removals)


def _checks_from(reader: CheckedValues) -> tuple[GateCheck, ...]:
    checks = []
    for check in reader.get('gate', list_of(mapping_of(anything))):
        one = CheckedValues(reader.path, {'gate': check})
        checks.append(
            GateCheck(
                name=one.get('gate.name', string),
                option=one.get('gate.option', string),
                found=one.get('gate.found', finite_or_null),
                limit=one.get('gate.limit', finite_or_null),
                unit=one.get('gate.unit', string),
                kept=None
                if one.get('gate.kept', is_null)
                else one.get('gate.kept', true_or_false),
                note=one.get('gate.note', string),
            )
        )
    return tuple(checks)


def _correlation_from(reader: CheckedValues) -> Correlation:
    names = reader.get('correlation.names', strings)
    matrix = np.array(reader.get('correlation.matrix', grid_of(finite_or_null)))
    if matrix.shape != (len(names), len(names)):
        raise ProductError(f'{reader.path}: correlation.matrix is not of the size of its names')
    return Correlation(names, matrix)


def _thermal_from(reader: CheckedValues) -> Thermal:
    focal = reader.get('temperature.focal_per_degc', list_of(finite_number))
    rate = reader.get('temperature.alignment_rate_rad_per_degc', row_of_numbers(0, 3))
    focal_sigma = reader.get(
        'temperature.focal_per_degc_sigma', row_of_numbers(len(focal), null=True)
    )
    rate_sigma = reader.get(
        'temperature.alignment_rate_rad_per_degc_sigma', row_of_numbers(len(rate), null=True)
    )
    return Thermal(
        reference_degc=reader.get('temperature.reference_degc', finite_number),
        focal_per_degc=tuple(focal),
        focal_sigma=tuple(focal_sigma),
        alignment_rate_rad_per_degc=tuple(rate),
        alignment_rate_sigma=tuple(rate_sigma),
        note=reader.get('temperature.note', string),
    )


def _json_number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _json_row(values: Floats) -> list[float | None]:
    return [_json_number(value) for value in np.asarray(values).tolist()]


def _json_rows(values: Floats) -> list[list[float | None]]:
    return [_json_row(row) for row in values]
