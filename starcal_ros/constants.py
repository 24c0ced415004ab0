"""Physical and angular constants, each with its authority."""

from __future__ import annotations

import math

ARCSECOND_RAD = math.pi / 648000.0  # definition
SPEED_OF_LIGHT_M_S = 299792458.0  # SI, exact
AU_M = 149597870700.0  # IAU 2012 Resolution B2, exact
NANOSECONDS_PER_SECOND = 1_000_000_000
