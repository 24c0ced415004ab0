# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Types of arrays."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Record = TypeVar('Record', bound=DataclassInstance)

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


def rows_of(record: Record, rows: Mask | Indices | Rows | slice) -> Record:
    """Record with some rows of each of its arrays (n, ...): a mask (n,), numbers or a slice."""
    if not isinstance(rows, slice) and rows.dtype == np.bool_:
        rows = np.flatnonzero(rows)  # `take` needs a tenth of the time of a mask
    columns = {
        field.name: value[rows] if isinstance(rows, slice) else value.take(rows, axis=0)
        for field in fields(record)
        if isinstance(value := getattr(record, field.name), np.ndarray)
    }
    return replace(record, **columns)
