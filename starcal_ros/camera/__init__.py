# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibrated camera: lens models, the field over the detector, conversion between models."""

from starcal_ros.camera.projection import (
    ALL_PARAMETER_NAMES,
    CameraModel,
    check_plausible,
    distortion_px,
    field_radius_rad,
    INTRINSIC_NAMES,
    line_of_sight,
    MAX_SIDE_PX,
    PARAMETER_NAMES,
    parameter_names,
    pixel_grid,
    project,
    project_jacobians,
    project_parameters,
    rotation_jacobian,
)
