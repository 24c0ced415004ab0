# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The frozen records that pass between the stages: images -> observations -> calibration.

Arrays in records are never changed after construction.  The types of the fields, with their marks
(`arrays`), are the one description of a record: ``products/json_codec.py`` and
``messages/codec.py`` write and read JSON and messages from them.
"""

from starcal_ros.records.calibration import (
    ALIGNMENT_NAMES,
    Calibration,
    calibration_parameter_names,
    CameraGeometry,
    check_calibration,
    check_drawable,
    Correlation,
    DetectorMaps,
    GateCheck,
    TemperatureTerms,
    TermRemoval,
)
from starcal_ros.records.model_checks import (
    Amplitude,
    DetectorStep,
    HeldTerm,
    ModelChecks,
    ResidualBin,
)
from starcal_ros.records.observations import (
    AttitudeSample,
    counted_refusal,
    Ensemble,
    EnsembleStatus,
    Image,
    IMAGE_REFUSALS,
    refused_image,
    STAR_COLUMNS,
    STAR_REFUSALS,
    StarObservations,
    StarRefusal,
)
from starcal_ros.records.residual_field import factored_field, MapCovariance, ResidualField
from starcal_ros.records.sigma_budget import parts_that_matter, SigmaPart, TOTAL
from starcal_ros.records.star_trackers import StarTrackerAlignment

__all__ = [
    'ALIGNMENT_NAMES',
    'IMAGE_REFUSALS',
    'STAR_COLUMNS',
    'STAR_REFUSALS',
    'TOTAL',
    'Amplitude',
    'AttitudeSample',
    'Calibration',
    'CameraGeometry',
    'Correlation',
    'DetectorMaps',
    'DetectorStep',
    'Ensemble',
    'EnsembleStatus',
    'GateCheck',
    'HeldTerm',
    'Image',
    'MapCovariance',
    'ModelChecks',
    'ResidualBin',
    'ResidualField',
    'SigmaPart',
    'StarObservations',
    'StarRefusal',
    'StarTrackerAlignment',
    'TemperatureTerms',
    'TermRemoval',
    'calibration_parameter_names',
    'check_calibration',
    'check_drawable',
    'counted_refusal',
    'factored_field',
    'parts_that_matter',
    'refused_image',
]
