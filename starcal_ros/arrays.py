"""Array types shared by the whole package; shapes, units and frames stand in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]  # grey (h, w) or BGR (h, w, 3), for people
Pixels = NDArray[np.uint8] | NDArray[np.uint16]  # as delivered, indexed [v, u]
