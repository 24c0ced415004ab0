# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The frozen records that pass between the stages: images -> observations -> calibration.

Arrays in records are never changed after construction.  The types of the fields with their marks
are the only description of a record: `record_fields` reads and writes JSON and messages by them.
"""

from starcal_ros.records.calibration import (
    Activation,
    ALIGNMENT_NAMES,
    Calibration,
    CameraGeometry,
    check_calibration,
    check_drawable,
    Correlation,
    DetectorMaps,
    GateCheck,
    TemperatureTerms,
)
from starcal_ros.records.calibration_parts import (
    Amplitude,
    BUDGET_COLUMNS,
    BUDGET_ROWS,
    DetectorStep,
    factored_field,
    HeldTerm,
    MapCovariance,
    ModelChecks,
    parts_that_matter,
    ResidualBin,
    ResidualField,
    SigmaPart,
    StarTrackerAlignment,
    Statement,
    TOTAL,
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
