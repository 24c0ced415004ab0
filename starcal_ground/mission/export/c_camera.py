# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A calibration for C99 and C++17: header, source, and the numbers as a binary table.

The table is little-endian: a header of 120 bytes, numbers of 64 bits, the names of the budget,
terms of the field (2 x uint16) and the covariance of the field (int16).  The CRC-32 covers all
after itself.  `starcal_load` in ``c/starcal_camera.c`` is its reader.
"""

from __future__ import annotations

from collections.abc import Iterator
import hashlib
from importlib import resources
import re
import struct
import sys
import zlib

import numpy as np

from starcal_ground.mission.export.exported import ascii_line, Content, origin
from starcal_ground.mission.export.request import Request
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import common_rotation, Derivatives
from starcal_ros.camera import pixel_grid
from starcal_ros.camera.lens import fold_radius2
from starcal_ros.errors import OptionError
from starcal_ros.estimation.problem import camera_at
from starcal_ros.formats.products.product_files import calibration_text
from starcal_ros.records import Calibration, ResidualField
from starcal_ros.records.residual_field import NO_VARIANCE

TABLE_FILE = 'starcal_camera.bin'
_MAGIC = b'STARCALT'
_VERSION = 1  # STARCAL_TABLE_VERSION
# The enumeration of starcal_camera.c.
_MODELS = {
    'plumb_bob': 0,
    'rational_polynomial': 1,
    'thin_prism': 2,
    'tilted': 3,
    'equidistant': 4,
}
_MOST_WAVES = 128  # STARCAL_MAX_WAVES
_NAME_SIZE = 32  # STARCAL_NAME_SIZE
_VECTORS_A_SIDE = 5
_VECTOR_STEP_K = 7.0  # temperature step between test vectors
_NO_FOLD = sys.float_info.max  # the table has finite numbers only
_BYTES_A_LINE = 20


def c_content(calibration: Calibration, asked: Request) -> Content:
    """C99 source of a calibration, or the table of its numbers alone."""
    return Content({TABLE_FILE: c_table(calibration)} if asked.table else c_files(calibration))


def c_files(calibration: Calibration) -> dict[str, str]:
    """Texts of header and source by name; raises as `c_table`."""
    table = c_table(calibration)
    lines = (
        ', '.join(map(str, table[k : k + _BYTES_A_LINE])) + ','
        for k in range(0, len(table), _BYTES_A_LINE)
    )
    about = ''.join(f' * {_comment(line)}\n' for line in origin(calibration))
    folder = resources.files('starcal_ground.mission.export') / 'c'
    header, source = ((folder / f'starcal_camera.{end}').read_text('utf-8') for end in 'hc')
    source = source.replace('@TABLE@', '\n'.join(lines))
    return {'starcal_camera.h': header, 'starcal_camera.c': f'/*\n{about} */\n{source}'}


def _comment(text: str) -> str:
    """Text within a comment of C: without what opens or closes one, and without trigraphs."""
    return re.sub(r'(?<=[*/])(?=[*/])|(?<=\?)(?=\?)', ' ', ascii_line(text))


def c_table(calibration: Calibration) -> bytes:
    """
    Binary table of a calibration.

    Raises OptionError for a lens model that the C code does not have, and for a field with more
    waves than it has room for.
    """
    camera = calibration.geometry.camera
    number = _MODELS.get(camera.model)
    if number is None:
        raise OptionError(f'--to c: the C code has no lens model {camera.model}')
    field = _factored(calibration)
    terms = np.empty((0, 2), np.int64) if camera.field is None else camera.field.orders
    if terms.max(initial=0) >= _MOST_WAVES:
        raise OptionError(
            f'--to c: the field has {terms.max() + 1} waves along an axis, over {_MOST_WAVES}'
        )
    common = common_rotation(camera)
    count = 2 * len(terms)
    triangle, units = np.zeros((count, count)), np.zeros(count)
    if len(field.remainder):
        triangle[np.tril_indices(count)] = field.remainder
        units[:] = field.remainder_unit_px
    root = np.zeros((len(common[0]), count))
    root[len(root) - count :] = triangle * units[:, None]
    turned = common @ np.concatenate([field.covariance_factor, root], axis=1)
    vectors = np.array(list(_vectors(calibration, common)))
    numbers = [
        camera.parameters,
        [min(fold_radius2(camera.model, camera.distortion), _NO_FOLD)],
        calibration.geometry.star_tracker_from_camera.as_matrix() * calibration.has_alignment,
        _temperature(calibration),
        [field.unresolved_px],
        field.coefficients,
        field.covariance_factor,
        units,
        turned,
        vectors,
    ]
    body = np.concatenate([np.ravel(array) for array in numbers]).astype('<f8').tobytes()
    for part in calibration.sigma_budget:
        body += ascii_line(part.cause).encode()[: _NAME_SIZE - 1].ljust(_NAME_SIZE, b'\0')
        body += struct.pack('<2d', part.map_arcsec, part.pointing_arcsec)
    body += terms.astype('<u2').tobytes()
    body += triangle.T[np.triu_indices(len(triangle))].astype('<i2').tobytes()
    head = struct.pack(
        '<8I12xq32s16x',
        number,
        camera.width,
        camera.height,
        len(terms),
        field.covariance_factor.shape[1],
        len(calibration.sigma_budget),
        len(vectors),
        len(camera.parameters),
        calibration.time_ns,
        identity(calibration),
    )
    crc = zlib.crc32(head + body)
    size = len(_MAGIC) + 12 + len(head) + len(body)
    return _MAGIC + struct.pack('<3I', _VERSION, size, crc) + head + body


def identity(calibration: Calibration) -> bytes:
    """SHA-256 of ``calibration.json``, as this version writes it."""
    return hashlib.sha256(calibration_text(calibration).encode()).digest()


def _factored(calibration: Calibration) -> ResidualField:
    """Return the field with its covariance as a factor; of no terms where there is none."""
    field, camera = calibration.field, calibration.geometry.camera
    if field is not None and camera.field is not None:
        return field
    scale = np.where(calibration.sigma > 0, calibration.sigma, 1.0)
    values, vectors = np.linalg.eigh(calibration.covariance / np.outer(scale, scale))
    used = values > NO_VARIANCE * max(values.max(), 0.0)
    factor = scale[:, None] * vectors[:, used] * np.sqrt(values[used])
    return ResidualField(0, np.empty((2, 0)), 0.0, factor, np.empty(0), np.empty(0, np.int16))


def _temperature(calibration: Calibration) -> list[float]:
    terms = calibration.temperature
    if terms is None:
        return [0.0] * 6
    rate = terms.alignment_rate_rad_per_degc or (0.0, 0.0, 0.0)
    return [terms.reference_degc, *terms.focal_per_degc, 0.0, 0.0][:3] + list(rate)


def _vectors(calibration: Calibration, common: Floats) -> Iterator[Floats]:
    """
    Yield temperature, pixel, direction, and the covariances of pointing and of shape, (24,).

    The common rotation is that of the camera at the reference, as in the table.
    """
    terms = calibration.temperature
    reference = 0.0 if terms is None else terms.reference_degc
    pixels = pixel_grid(calibration.geometry.camera, _VECTORS_A_SIDE, _VECTORS_A_SIDE)
    for k, pixel in enumerate(pixels):
        degc = reference + _VECTOR_STEP_K * (k % 3 - 1)
        camera = camera_at(calibration, degc).camera
        there = Derivatives.at(camera, pixel[None])
        if not np.isfinite(there.directions).all():
            continue
        covariances = [
            there.covariance_rad2(calibration.map_covariance, J).ravel()
            for J in (there.J, there.of_shape(camera, common))
        ]
        yield np.concatenate([[degc], pixel, there.directions[0], *covariances])
