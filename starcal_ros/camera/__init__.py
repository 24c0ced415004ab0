# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibrated camera: lens models, the field over the detector, conversion between models."""

from starcal_ros.camera.projection import *
