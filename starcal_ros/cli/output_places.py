# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Places of outputs: no command replaces an input, or a file of another origin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcal_ros.errors import OptionError
from starcal_ros.files import same_as_one_of
from starcal_ros.formats.bag import reader
from starcal_ros.formats.products.calibration_json import CALIBRATION_FILE
from starcal_ros.formats.products.product_files import check_not_inputs
from starcal_ros.formats.products.product_folder import NOT_CALIBRATED_FILE, PRODUCT_FILES
from starcal_ros.report.pictures.thumbnails import THUMBNAILS_FOLDER


def check_folder(folder: Path, bags: Sequence[Path], files: Sequence[Path]) -> None:
    """
    Check that the products of a calibration replace no input and do not become part of a bag.

    Raises OptionError or ProductError naming the folder or the file.
    """
    bag_files = reader.files_of_bags(bags)
    if same_as_one_of(folder, [file.parent for file in bag_files]):
        raise OptionError(f'{folder}: holds the bag that is read; choose another folder (-o)')
    check_not_inputs([folder / name for name in PRODUCT_FILES], (*bag_files, *files))
    pictures = folder / THUMBNAILS_FOLDER
    records = (CALIBRATION_FILE, NOT_CALIBRATED_FILE)
    is_old = any((folder / name).exists() for name in records) and not pictures.is_symlink()
    if pictures.is_dir() and any(pictures.iterdir()) and not is_old:
        raise OptionError(f'{pictures}: is not of a calibration; choose another folder (-o)')


def check_no_product(output: Path, calibrations: Sequence[Path]) -> None:
    """
    Check that an output is neither a calibration that is read nor another product beside it.

    Raises ProductError naming the file.
    """
    beside = [file.with_name(name) for file in calibrations for name in PRODUCT_FILES]
    check_not_inputs([output], [*calibrations, *beside])
