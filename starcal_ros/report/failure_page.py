# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a calibration that failed, in place of its report."""

from __future__ import annotations

import base64
from pathlib import Path

import jinja2
from markupsafe import Markup

from starcal_ros.constants import utc_text
from starcal_ros.products.files import REPORT_FILE, write_atomically
from starcal_ros.products.not_calibrated import NotCalibrated
from starcal_ros.records import IMAGE_REFUSALS
from starcal_ros.report.pictures.expected import EXPECTED
from starcal_ros.report.pictures.thumbnails import read_thumbnails, THUMBNAILS_FOLDER


def write_failure_page(record: NotCalibrated, folder: Path) -> Path:
    """
    Write ``report.html`` of a failure and return its path.

    Raises
    ------
    ProductError
        When the page cannot be written.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('starcal_ros.report'),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pictures = [
        (
            # Safe as markup: base64 has no special characters.
            Markup(f'data:image/png;base64,{base64.b64encode(one.encoded).decode("ascii")}'),
            utc_text(one.time_ns),
        )
        for one in read_thumbnails(folder / THUMBNAILS_FOLDER)
        if one.reason == EXPECTED
    ]
    refused = [
        (count, reason, IMAGE_REFUSALS.get(reason, ''))
        for reason, count in record.images_refused.items()
    ]
    text = environment.get_template('failure.html').render(
        record=record, pictures=pictures, refused=refused
    )
    path = folder / REPORT_FILE
    write_atomically(path, text)
    return path
