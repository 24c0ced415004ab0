# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Types of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

AnyArray = NDArray[Any]
Codes = NDArray[np.uint8]  # members of an enumeration
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Integers = NDArray[np.int64]  # stamps, identifiers, counts
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]  # (h, w) grey or (h, w, 3) BGR, for display
Pixels = NDArray[np.uint8] | NDArray[np.uint16]  # detector counts, indexed [v, u]
Rows = NDArray[np.intp]  # row numbers of a table, the type that NumPy searches return
Singles = NDArray[np.float32]  # for whole images, where double precision would take longer
