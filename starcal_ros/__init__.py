# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
In-flight geometric calibration of a spacecraft camera from images of stars.

After Christian, Benhacine, Hikes and D'Souza, "Geometric Calibration of the Orion Optical
Navigation Camera using Star Field Images", J. Astronaut. Sci. 2016,
DOI 10.1007/s40295-016-0091-3.  Equation numbers in the docstrings are that paper's.

Conventions of the whole package:

- Frames: ``icrf`` (inertial), ``star_tracker``, ``camera`` (+x right, +y down, +z out).
- ``b_from_a`` transforms coordinates in frame a to coordinates in frame b.
- Quaternions are scalar-last (x, y, z, w).
- Small angles are passive rotations in the camera frame:
  ``camera_from_icrf <- exp(-[dtheta x]) camera_from_icrf``  (Eq. 11).
- Pixels are (u right, v down); the centre of the first pixel is (0, 0); images index ``[v, u]``.
- Angles are radians inside and arcseconds for people; times are integer nanoseconds since the
  Unix epoch (UTC, as ROS stamps); directions are unit vectors; xyz is the last axis.

The public functions and records are those of ``__all__``: what a consumer of calibrations needs on
the vehicle.  Each is imported at its first use, so that ``import starcal_ros`` loads neither NumPy
nor OpenCV.  Calibrations are made by the nodes, or on the ground by ``starcal_ground``.
"""

import sys

# ``python -m starcal_ros...`` in the folder of an untrusted bag would import a ``yaml.py`` that
# lies there.  Before any other import, __future__ included; other programs keep their path.
_is_found = sys.argv[:1] == ['-m'] and not getattr(sys.flags, 'safe_path', False)
if _is_found and any(word.startswith('starcal_ros.') for word in sys.orig_argv):
    del sys.path[0]

from typing import TYPE_CHECKING  # noqa: E402

if TYPE_CHECKING:
    from starcal_ros.assessment.lookup import (
        line_of_sight_covariance,
        line_of_sight_sigma_arcsec,
        lines_of_sight,
        project,
    )
    from starcal_ros.camera import CameraModel
    from starcal_ros.errors import OptionError, StarcalError, TooFewObservations
    from starcal_ros.formats.products.product_files import read_calibration
    from starcal_ros.records import Calibration, CameraGeometry, StarObservations

    __version__: str

__all__ = [
    'Calibration',
    'CameraGeometry',
    'CameraModel',
    'OptionError',
    'StarObservations',
    'StarcalError',
    'TooFewObservations',
    '__version__',
    'line_of_sight_covariance',
    'line_of_sight_sigma_arcsec',
    'lines_of_sight',
    'project',
    'read_calibration',
]

if not TYPE_CHECKING:  # a checker sees the imports above, and no other names
    _MODULES = {
        'assessment.lookup': (
            'line_of_sight_covariance',
            'line_of_sight_sigma_arcsec',
            'lines_of_sight',
            'project',
        ),
        'camera': ('CameraModel',),
        'errors': ('OptionError', 'StarcalError', 'TooFewObservations'),
        'formats.products.product_files': ('read_calibration',),
        'records': ('Calibration', 'CameraGeometry', 'StarObservations'),
    }
    _MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

    def __getattr__(name: str) -> object:
        """Import a public name at its first use (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        if name == '__version__':
            from starcal_ros.constants import software_version

            value: object = software_version()
        else:
            import importlib

            value = getattr(importlib.import_module(f'{__name__}.{_MODULE_OF[name]}'), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Names of the module, the public ones that are not imported yet included."""
    return sorted({*globals(), *__all__})
