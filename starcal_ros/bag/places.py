# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Places of bags that are made here: no file of another origin is replaced."""

from __future__ import annotations

from collections.abc import Iterable
import json
import os
from pathlib import Path

from starcal_ros.bag.writer import BagWriter
from starcal_ros.errors import BagError
from starcal_ros.untrusted import PRODUCT_BYTES, read_text

_OF_BAGS = ('metadata.yaml', '*.mcap', '*.db3')


def check_replaceable(
    bag: Path, record: Path, others: Iterable[Path], mark: str, kind: str
) -> None:
    """
    Check that a bag and the files beside it replace nothing but an earlier bag of their kind.

    Parameters
    ----------
    record : Path
        JSON object beside the bag; ``bag`` in it names the file of the bag.
    others : iterable of Path
        Further files to write.
    mark : str
        Key that only records of this kind have.
    kind : str
        Description for the error message, as 'a simulated bag'.

    Raises
    ------
    BagError
        Naming a file of another origin.
    """
    file = BagWriter(bag).file
    there = [path for path in (file, record, *others) if os.path.lexists(path)]
    if bag != file:
        there += [path for end in _OF_BAGS for path in bag.glob(end)]
    if there and not _is_record_of(file.name, record, mark):
        raise BagError(f'{there[0]}: is not of {kind} and would be replaced; choose another place')


def _is_record_of(bag_name: str, record: Path, mark: str) -> bool:
    try:
        content = json.loads(read_text(record, PRODUCT_BYTES))
        return bool(content['bag'] == bag_name and content[mark])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False
