# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The frozen records that pass between the stages: images -> observations -> calibration.

Arrays in records are never changed after construction.  The types of the fields with their marks
are the only description of a record: `record_fields` reads and writes JSON and messages by them.
"""

from starcal_ros.records.calibration import *
from starcal_ros.records.observations import *
from starcal_ros.records.residual_field import *
