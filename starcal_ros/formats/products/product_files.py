# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of products: text of limited size, and contents written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from starcal_ros import untrusted
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.files import replacing, same_as_one_of

OBSERVATIONS_FILE = 'observations.mcap'
REPORT_FILE = 'report.html'


def read_text(path: Path, most_bytes: int) -> str:
    """
    The text of a file in UTF-8.

    Raises ProductError when the file cannot be read, is larger than ``most_bytes`` or is no text.
    """
    with errors_as(ProductError, path):
        return untrusted.read_text(path, most_bytes)


def read_json(path: Path) -> Any:
    """
    The value of a JSON file, as `untrusted.json_value` reads it.

    Raises ProductError when the file cannot be read, is too large or not JSON.
    """
    with errors_as(ProductError, path):
        return untrusted.json_value(read_text(path, untrusted.PRODUCT_BYTES))


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    Replace a file whole: readers, and a power loss, see the old one or the new one.

    Raises ProductError when the file cannot be written; the old one is then unchanged.
    """
    with errors_as(ProductError, path, 'written'), replacing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def check_not_inputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """
    Compare the files that a command will write with those that it reads.

    Raises ProductError naming a file that is both: no input is ever replaced.
    """
    inputs = tuple(inputs)
    for path in outputs:
        if same_as_one_of(path, inputs):
            raise ProductError(
                f'{path}: is an input of this command and would be replaced; choose another '
                'place (-o)'
            )
