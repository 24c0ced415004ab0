# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Files of products: written whole or not at all; ``calibration.json``, both ways.

Most keys of ``calibration.json`` are the fields of `Calibration`, by `record_fields`.  Camera and
alignment have the shape that the interface document publishes, which is described here.  Numbers
are written with the shortest digits that read back to the same double, so a calibration that was
written and read is equal to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from starcal_ros import untrusted
from starcal_ros.camera import CameraModel
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.files import replacing
from starcal_ros.record_fields import Count, Finite, json_object, Quaternion, read_record
from starcal_ros.records import ALIGNMENT_NAMES, Calibration, CameraGeometry, check_calibration
from starcal_ros.untrusted import shown

STATE_CALIBRATIONS, STATE_ENSEMBLE = 'calibrations', 'ensemble'  # in a state folder
STATE_ACTIVE = 'active.json'
SCHEMA = 1
_LONGEST_REASON = 500  # characters: a text of the file may be in it
CALIBRATION_FILE = 'calibration.json'
_INTRINSICS = 5  # the first parameters of every camera model: fx, skew, fy, cx, cy
_REPLACED = ('geometry', 'parent_frame', 'child_frame')  # by the keys of `_Published`


def read_text(path: Path, most_bytes: int) -> str:
    """Text of a file in UTF-8 of at most ``most_bytes``; raises ProductError."""
    with errors_as(ProductError, path):
        return untrusted.read_text(path, most_bytes)


def read_json(path: Path) -> Any:
    """Value of a JSON file, as `untrusted.json_value` reads it; raises ProductError."""
    with errors_as(ProductError, path):
        return untrusted.json_value(read_text(path, untrusted.PRODUCT_BYTES))


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    Replace a file whole: readers, and a power loss, see the old one or the new one.

    Raises ProductError when the file cannot be written; the old one is then unchanged.
    """
    data = content.encode() if isinstance(content, str) else content
    with errors_as(ProductError, path, 'written'), replacing(path) as file:
        file.write(data)


@dataclass(frozen=True)
class _Alignment:
    """The key ``alignment``."""

    parent: str
    child: str
    quaternion_xyzw: Quaternion


@dataclass(frozen=True)
class _ImageSize:
    """The key ``image``."""

    width: Count
    height: Count


@dataclass(frozen=True)
class _Published:
    """
    Camera and alignment as the interface document has them.

    ``alignment_covariance_rad2`` repeats a block of the covariance for readers of the file.
    """

    intrinsics: Mapping[str, Annotated[float, Finite()]]
    distortion: Mapping[str, Annotated[float, Finite()]]
    alignment: _Alignment
    parameter_names: tuple[str, ...]
    image: _ImageSize
    model: str

    def geometry(self) -> CameraGeometry:
        """Camera and alignment; raises ValueError for parameters of another camera model."""
        names = self.parameter_names[: -len(ALIGNMENT_NAMES)]
        given = {'intrinsics': names[:_INTRINSICS], 'distortion': names[_INTRINSICS:]}
        parameters = []
        for group, expected in given.items():
            values: Mapping[str, float] = getattr(self, group)
            for name in expected:
                if name not in values:
                    raise ValueError(f'key {f"{group}.{name}"!r} is missing')
                parameters.append(values[name])
        size = self.image
        camera = CameraModel(size.width, size.height, np.array(parameters), self.model)
        expected_names = camera.parameter_names + ALIGNMENT_NAMES
        if self.parameter_names != expected_names:
            raise ValueError(f'parameter_names: not {", ".join(expected_names)}')
        return CameraGeometry(camera, self.alignment.quaternion_xyzw)


@dataclass(frozen=True)
class ActiveFile:
    """
    Which calibration of a state folder is active, and why others are not any more.

    ``active`` is the path of its file within the folder, empty if none is active; ``events`` the
    number of the last event that this takes into account.
    """

    schema: int
    events: Count
    active: str
    withdrawn: tuple[str, ...] = ()


def check_readable(calibration: Calibration) -> None:
    """Raise ProductError where `read_calibration` would refuse the file of a calibration."""
    content = untrusted.json_value(calibration_text(calibration))
    calibration_from_content(Path(CALIBRATION_FILE), content)


def calibration_text(calibration: Calibration) -> str:
    """Content of ``calibration.json``."""
    return f'{_text(calibration_content(calibration))}\n'


def _text(value: object, margin: str = '\n') -> str:
    """JSON text: a key or an item on a line, a list of numbers, as a row of a grid, on one."""
    inner = f'{margin} '
    if isinstance(value, dict) and value:
        rows = [f'{json.dumps(key)}: {_text(item, inner)}' for key, item in value.items()]
        return f'{{{inner}{f",{inner}".join(rows)}{margin}}}'
    if isinstance(value, list) and {dict, list, str} & set(map(type, value)):
        return f'[{inner}{f",{inner}".join(_text(item, inner) for item in value)}{margin}]'
    return json.dumps(value, allow_nan=False)


def read_calibration(path: Path | str) -> Calibration:
    """
    The calibration of a ``calibration.json``, or of the folder that holds one.

    Equal to the one written, to the last bit.

    Raises
    ------
    ProductError
        Naming the file and the key that is missing or wrong.

    Examples
    --------
    After ``starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out``:

    >>> import starcal_ros
    >>> starcal_ros.read_calibration('out').method
    'hierarchical'
    """
    file = calibration_file(Path(path))
    return calibration_from_content(file, read_json(file))


def calibration_file(path: Path) -> Path:
    """
    Path of the calibration in a folder, the active one in a state folder, or the file itself.

    Raises ProductError if there is none.
    """
    if not path.is_dir():
        return path
    if (path / CALIBRATION_FILE).exists():
        return path / CALIBRATION_FILE
    activated = (path / STATE_CALIBRATIONS).glob(f'{8 * "[0-9]"}*_calibration_*.json')
    events = {int(file.name.partition('_')[0]): file for file in activated}
    if not events:
        raise ProductError(f'{path}: the folder holds no {CALIBRATION_FILE}')
    last = events[max(events)]
    if not (path / STATE_ACTIVE).exists():
        return last
    with errors_as(ProductError, path / STATE_ACTIVE):
        stated = read_record(ActiveFile, read_json(path / STATE_ACTIVE))
    if max(events) > stated.events:  # a kill came before the activation was stated
        return last
    active = next((file for file in events.values() if file == path / stated.active), None)
    if active is None:
        why = '; '.join(('no calibration is active', *stated.withdrawn))
        raise ProductError(f'{path}: {why}; to read one all the same, give its file')
    return active


def calibration_from_content(path: Path, content: object) -> Calibration:
    """
    The calibration in the JSON object of a ``calibration.json``; other keys are ignored.

    Raises ProductError naming the file ``path`` and the key that is missing or wrong.
    """
    if not isinstance(content, dict):
        raise ProductError(f'{path}: not a calibration (no JSON object)')
    if 'schema' not in content:
        raise ProductError(f'{path}: not a calibration (no key schema)')
    if content['schema'] != SCHEMA:
        raise ProductError(f'{path}: schema {shown(content["schema"])} is not {SCHEMA}')
    try:
        published = read_record(_Published, content)
        nested = {
            'geometry': published.geometry(),
            'parent_frame': published.alignment.parent,
            'child_frame': published.alignment.child,
        }
        calibration = read_record(Calibration, {**content, **nested})
        check_calibration(calibration)
        return calibration
    except ValueError as error:
        reason = ' '.join(str(error).split())
        raise ProductError(f'{path}: {reason[:_LONGEST_REASON]}') from error


def calibration_content(calibration: Calibration) -> dict[str, object]:
    """The JSON object of a calibration: the keys of the interface document, then the others."""
    camera = calibration.geometry.camera
    named = list(zip(camera.parameter_names, camera.parameters.tolist(), strict=True))
    published = json_object(
        _Published(
            intrinsics=dict(named[:_INTRINSICS]),
            distortion=dict(named[_INTRINSICS:]),
            alignment=_Alignment(
                calibration.parent_frame,
                calibration.child_frame,
                calibration.geometry.star_tracker_from_camera_xyzw,
            ),
            parameter_names=calibration.parameter_names,
            image=_ImageSize(camera.width, camera.height),
            model=camera.model,
        )
    )
    others = json_object(calibration)
    for key in _REPLACED:
        del others[key]
    covariance = others.pop('covariance')
    angles = len(camera.parameters)
    return {
        'schema': SCHEMA,
        **published,
        'covariance': covariance,
        'alignment_covariance_rad2': [row[angles:] for row in covariance[angles:]],
        **others,
    }
