"""
A calibration as arguments of the camera models of NASA's GIANT.

GIANT's ``OpenCVModel`` is OpenCV's rational model with thin prism, skew (``alpha``) and a focal
length that depends on temperature (``giant/camera_models/opencv_model.py``, its equations).
"""

from __future__ import annotations

import dataclasses
import json

from starcal_ros.export.losses import Fitted, fitted, in_words
from starcal_ros.export.provenance import origin, PIXEL_CONVENTION
from starcal_ros.records import Calibration

_HELD = ('plumb_bob', 'rational_polynomial', 'thin_prism')  # special cases of OpenCVModel
_NAMES = {'fx': 'fx', 'fy': 'fy', 'skew': 'alpha', 'cx': 'px', 'cy': 'py'}


def giant_json(calibration: Calibration) -> tuple[str, Fitted]:
    """
    JSON whose ``OpenCVModel`` holds the keyword arguments of the model; and the camera in it.

    ``star_tracker_from_camera_xyzw`` is beside them: GIANT has no alignment in a camera model.
    """
    own = calibration.geometry.camera.model
    found = fitted(calibration, own if own in _HELD else 'thin_prism', ())
    # GIANT has the change of the focal length with temperature: it is no loss.
    losses = tuple(loss for loss in found.losses if 'focal' not in loss.part)
    found = dataclasses.replace(found, losses=losses)
    camera = found.camera
    named = zip(camera.parameter_names, camera.parameters.tolist(), strict=True)
    arguments = {_NAMES.get(name, name): value for name, value in named}
    arguments |= {'n_rows': camera.height, 'n_cols': camera.width}
    terms = calibration.temperature
    if terms is not None and terms.focal_per_degc:
        # GIANT scales x' by 1 + a1 T + a2 T^2 with T itself: give it T - reference_degc.
        arguments |= {f'a{k}': value for k, value in enumerate(terms.focal_per_degc, start=1)}
    content = {
        'about': [
            *origin(calibration),
            *in_words(found.worst_px, losses),
            *PIXEL_CONVENTION,
            'from giant.camera_models import OpenCVModel; OpenCVModel(**content["OpenCVModel"])',
        ],
        'OpenCVModel': arguments,
        'temperature_reference_degc': None if terms is None else terms.reference_degc,
        'star_tracker_from_camera_xyzw': (
            calibration.geometry.star_tracker_from_camera_xyzw.tolist()
        ),
    }
    return json.dumps(content, indent=1) + '\n', found
