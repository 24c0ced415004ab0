# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Ground side of starcal: the tool, reports, images without attitudes, mission formats, trends.

``starcal_ros`` flies and imports nothing of this package.  The library is the names of
``__all__``, those of ``starcal_ros`` included, each imported at its first use.
"""

import sys

# ``python -m starcal_ground...`` in the folder of an untrusted bag would import a ``yaml.py`` that
# lies there.  Before any other import, __future__ included; other programs keep their path.
_is_found = sys.argv[:1] == ['-m'] and not getattr(sys.flags, 'safe_path', False)
if _is_found and any(word.startswith('starcal_ground.') for word in sys.orig_argv):
    del sys.path[0]

from typing import TYPE_CHECKING  # noqa: E402

if TYPE_CHECKING:
    from starcal_ground.api import (
        calibrate,
        calibrate_bag,
        calibrate_images,
        calibrate_with_residuals,
        observations_of,
        write_calibration,
    )
    from starcal_ground.bags.reader import read_observations
    from starcal_ground.comparison import compare
    from starcal_ground.mission.export.wcs import directions_icrf
    from starcal_ground.products import read_residuals
    from starcal_ground.report.page import plot
    from starcal_ground.undistortion import undistort_maps
    from starcal_ros import (
        Calibration,
        CameraGeometry,
        CameraModel,
        line_of_sight_covariance,
        line_of_sight_sigma_arcsec,
        lines_of_sight,
        OptionError,
        project,
        read_calibration,
        StarcalError,
        StarObservations,
        TooFewObservations,
    )

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
    'calibrate',
    'calibrate_bag',
    'calibrate_images',
    'calibrate_with_residuals',
    'compare',
    'directions_icrf',
    'line_of_sight_covariance',
    'line_of_sight_sigma_arcsec',
    'lines_of_sight',
    'observations_of',
    'plot',
    'project',
    'read_calibration',
    'read_observations',
    'read_residuals',
    'undistort_maps',
    'write_calibration',
]

if not TYPE_CHECKING:  # a checker sees the imports above, and no other names
    _MODULES = {
        'calibrate': 'api',
        'calibrate_bag': 'api',
        'calibrate_images': 'api',
        'calibrate_with_residuals': 'api',
        'compare': 'comparison',
        'directions_icrf': 'mission.export.wcs',
        'observations_of': 'api',
        'plot': 'report.page',
        'read_observations': 'bags.reader',
        'read_residuals': 'products',
        'undistort_maps': 'undistortion',
        'write_calibration': 'api',
    }

    def __getattr__(name: str) -> object:
        """Import a public name at its first use (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        import importlib

        # The other names are those of `starcal_ros`, which a vehicle has too.
        module = f'{__name__}.{_MODULES[name]}' if name in _MODULES else 'starcal_ros'
        value: object = getattr(importlib.import_module(module), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Names of the module, the public ones that are not imported yet included."""
    return sorted({*globals(), *__all__})
