# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Provenance of a calibration: software, options, catalog, prior and observations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import hashlib
import importlib.metadata
import json
import math
import os
from pathlib import Path

import numpy as np

from starcal_ros.errors import errors_as, OptionError
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Ensemble
from starcal_ros.untrusted import regular_file


def provenance_of(setup: Setup, ensemble: Ensemble, inputs: Mapping[str, str]) -> dict[str, str]:
    """
    Provenance of a calibration, sufficient to repeat it.

    ``inputs`` maps the name of each input file to its digest.
    """
    prior = np.r_[setup.prior.camera.parameters, setup.prior.star_tracker_from_camera_xyzw]
    return {
        'software': f'starcal {software_version()}',
        'camera_name': setup.camera_name,
        'catalog': setup.catalog.digest,
        'options': json.dumps(setup.options(), sort_keys=True),
        'prior': json.dumps(prior.tolist()),
        'observations_sha256': _digest(ensemble),
        **{f'input {name}': value for name, value in inputs.items()},
    }


def inputs_of(
    files: Iterable[Path], is_stopped: Callable[[], bool] = lambda: False
) -> dict[str, str]:
    """
    SHA-256 of the files that a calibration is made from, by their paths.

    ``is_stopped`` is polled between blocks of 1 MB, so that another thread can stop it early; the
    digests are then invalid.
    """
    digests = {}
    for path in files:
        digest = hashlib.sha256()
        with errors_as(OptionError, path), regular_file(path) as file:
            while not is_stopped() and (block := file.read(1 << 20)):
                digest.update(block)
        # The bytes of a name that is not UTF-8 are written as Python writes them, \\xff.
        name = os.fsencode(path).decode(errors='backslashreplace')
        digests[name] = f'sha256:{digest.hexdigest()}'
    return digests


def _digest(ensemble: Ensemble) -> str:
    """
    SHA-256 of all input that an estimate reads from its images, in their order.

    For each image, little-endian: stamp (int64, ns), number of stars (int64), attitude, then by
    column catalog numbers (int64), directions, pixels and covariances, last the temperature if
    known.  It can be recomputed from recorded observations.
    """
    digest = hashlib.sha256()
    for image in ensemble.images:
        digest.update(np.array([image.time_ns, len(image)], '<i8').tobytes())
        digest.update(image.icrf_from_star_tracker_xyzw.astype('<f8').tobytes())
        digest.update(image.catalog_id.astype('<i8').tobytes())
        for column in (image.direction_icrf, image.measured_px, image.covariance_px2):
            digest.update(column.astype('<f8').tobytes())
        if not math.isnan(image.temperature_degc):
            digest.update(np.array(image.temperature_degc, '<f8').tobytes())
    return digest.hexdigest()


def software_version() -> str:
    """Version of the installed package; 'unknown' in a source tree that is not installed."""
    try:
        return importlib.metadata.version('starcal_ros')
    except importlib.metadata.PackageNotFoundError:
        return 'unknown'
