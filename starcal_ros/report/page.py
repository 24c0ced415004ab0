# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Report of a calibration as one self-contained HTML file, ``report.html``.

The report is made from the product files of a folder; a section whose file is missing states so.
The page needs no network: styles, script and pictures are embedded.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
import functools
import json
import math
from pathlib import Path

import jinja2
from markupsafe import Markup
import numpy as np

from starcal_ros.assessment.agreement import alignment_difference_rad
from starcal_ros.assessment.observability import movement_px
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.bag import reader
from starcal_ros.camera import INTRINSIC_NAMES
from starcal_ros.constants import ARCSECOND_RAD, utc_text
from starcal_ros.errors import ProductError
from starcal_ros.estimation.star_trackers import summary as tracker_summary
from starcal_ros.estimation.temperature import summary as thermal_summary
from starcal_ros.messages.types import OBSERVATIONS_TYPE
from starcal_ros.products.calibration_json import CALIBRATION_FILE, prior_of, read_calibration
from starcal_ros.products.camera_yaml import CAMERA_INFO_FILE
from starcal_ros.products.files import OBSERVATIONS_FILE, REPORT_FILE, write_atomically
from starcal_ros.products.not_calibrated import read_not_calibrated
from starcal_ros.products.residuals_npz import read_residuals, RESIDUALS_FILE
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    IMAGE_REFUSALS,
    STAR_REFUSALS,
    StarObservations,
)
from starcal_ros.report.charts import charts_of
from starcal_ros.report.failure_page import write_failure_page
from starcal_ros.report.model_rows import model_rows
from starcal_ros.report.pictures.annotation import STAR_MARKS
from starcal_ros.report.pictures.thumbnails import (
    read_thumbnails,
    star_of,
    Thumbnail,
    THUMBNAILS_FOLDER,
)
from starcal_ros.untrusted import json_value

_SLIDER_IMAGES, _SLIDER_STARS = 40, 12000  # in the page; a star takes 25 bytes
_LISTED_REFUSED = 200
_PRODUCTS = (CALIBRATION_FILE, CAMERA_INFO_FILE, RESIDUALS_FILE, OBSERVATIONS_FILE)


@dataclass(frozen=True)
class Found:
    """
    Contents of a folder; ``residuals`` and ``observations`` are None without a file.

    ``thumbnails`` are in the order of `ordered`, ``files`` the names of the products beside the
    report.
    """

    calibration: Calibration
    residuals: Residuals | None
    observations: tuple[StarObservations, ...] | None
    thumbnails: tuple[Thumbnail, ...]
    files: tuple[str, ...] = _PRODUCTS


@dataclass(frozen=True)
class Row:
    """Row of the parameter table; numbers as text, empty if absent."""

    name: str
    unit: str
    sigma: str
    change: str
    change_sigmas: str
    value: str = ''
    prior: str = ''
    moves_px: str = ''
    sigma_px: str = ''


def write_report(folder: Path) -> Path:
    """
    Write ``report.html`` from the product files of a folder and return its path.

    Where the last calibration into the folder failed, it is the page of that failure.

    Raises
    ------
    ProductError, BagError
        When a file cannot be read or the report cannot be written.
    """
    failure = read_not_calibrated(folder)
    if failure is not None:
        return write_failure_page(failure, folder)
    path = folder / REPORT_FILE
    write_atomically(path, render(read_folder(folder), folder))
    return path


def read_folder(folder: Path) -> Found:
    """
    Contents of the product files of a folder.

    Raises
    ------
    ProductError, BagError
        When there is no calibration, or a file is damaged.
    """
    calibration = read_calibration(folder / CALIBRATION_FILE)
    residuals = folder / RESIDUALS_FILE
    observations = folder / OBSERVATIONS_FILE
    recorded = None
    if observations.is_file():
        topic = reader.choose_topic([observations], OBSERVATIONS_TYPE)
        recorded = tuple(reader.read_observations([observations], topic))
    return Found(
        calibration,
        read_residuals(residuals) if residuals.is_file() else None,
        recorded,
        read_thumbnails(folder / THUMBNAILS_FOLDER),
        tuple(name for name in _PRODUCTS if (folder / name).is_file()),
    )


def render(found: Found, folder: Path) -> str:
    """
    HTML text of the report of a folder.

    Raises
    ------
    ProductError
        When the contents cannot be drawn.
    """
    try:
        return template().render(_context(found))
    # A file can hold numbers that no calibration has; the errors of drawing have no common base.
    except Exception as error:
        why = f'{type(error).__name__}: {error}'
        raise ProductError(f'{folder}: the products cannot be drawn: {why}') from error


@functools.cache
def template() -> jinja2.Template:
    """Template of the report, compiled at the first call."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('starcal_ros.report'),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template('report.html')


def _context(found: Found) -> Mapping[str, object]:
    calibration, residuals = found.calibration, found.residuals
    prior = prior_of(calibration)
    return {
        'calibration': calibration,
        'time': utc_text(calibration.time_ns),
        'active_since': utc_text(calibration.active_since_ns),
        'parameters': _parameter_rows(calibration, prior),
        'alignment': _alignment_rows(calibration, prior),
        'tiles': _tiles(calibration),
        'star_trackers': [tracker_summary(one) for one in calibration.star_trackers],
        'thermal': thermal_summary(calibration.temperature) if calibration.temperature else '',
        'charts': charts_of(calibration, residuals, found.observations or ()),
        'correlation': calibration.correlation,
        'slider': _slider(calibration, residuals),
        'refused_images': _refused_images(found),
        'refused_stars': _refused_stars(found),
        'model_rows': model_rows(calibration),
        'star_marks': _star_marks(found),
        'files': found.files,
        'has_images': any(not thumbnail.reason for thumbnail in found.thumbnails),
        'used_images': _used_images(found),
        'provenance': _provenance(calibration),
    }


def _options_of(calibration: Calibration) -> Mapping[str, object]:
    try:
        options = json_value(calibration.provenance['options'])
    except (KeyError, ValueError):
        return {}
    return options if isinstance(options, dict) else {}


def _number(value: float, form: str) -> str:
    return format(value, form).replace('-', '\N{MINUS SIGN}')


def _significant(value: float, sigma: float) -> str:
    """Format a value with two significant digits of its sigma."""
    if not (math.isfinite(sigma) and sigma > 0 and math.isfinite(value)):
        return f'{value:.8g}'
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return _number(value, f'.{min(decimals, 12)}f')


def _parameter_rows(calibration: Calibration, prior: CameraGeometry | None) -> list[Row]:
    camera, sigma = calibration.geometry.camera, calibration.sigma[:-3]
    if prior and prior.camera.model != camera.model:
        prior = None  # parameters of another lens model are no start of these
    changes = camera.parameters - (prior.camera.parameters if prior else camera.parameters)
    moves, sigma_moves = movement_px(camera, changes), movement_px(camera, sigma)
    rows = []
    for k, name in enumerate(camera.parameter_names):
        known, changed = sigma[k] > 0, prior and changes[k]
        held = '' if name in calibration.estimated else 'held, ' if known else 'held'
        rows.append(
            Row(
                name=name,
                unit='px' if name in INTRINSIC_NAMES else '',
                value=_significant(camera.parameters[k], sigma[k]),
                sigma=held + (f'{sigma[k]:.2g}' if known else ''),
                prior=_number(prior.camera.parameters[k], '.8g') if prior else '',
                change=_number(changes[k], '+.3g') if changed else '',
                change_sigmas=_number(changes[k] / sigma[k], '+.1f') if changed and known else '',
                moves_px=f'{moves[k]:.3f}' if changed else '',
                sigma_px=f'{sigma_moves[k]:.3f}' if known else '',
            )
        )
    return rows


def _alignment_rows(calibration: Calibration, prior: CameraGeometry | None) -> list[Row]:
    sigma = calibration.sigma[-3:] / ARCSECOND_RAD
    changes = (
        alignment_difference_rad(calibration.geometry, prior) / ARCSECOND_RAD
        if prior
        else np.zeros(3)
    )
    return [
        Row(
            name=axis,
            unit='arcsec',
            sigma=f'{sigma[k]:.2f}',
            change=_number(changes[k], '+.2f') if prior else '',
            change_sigmas=_number(changes[k] / sigma[k], '+.1f') if prior and sigma[k] > 0 else '',
        )
        for k, axis in enumerate('xyz')
    ]


def _none(count: int) -> str:
    return f'{count:,}' if count else 'none'


def _tiles(calibration: Calibration) -> list[tuple[str, str, str]]:
    """(name, number, note) of the main results."""
    rms_px = calibration.residual_rms_px
    pixel_arcsec = 1.0 / calibration.geometry.camera.parameters[0] / ARCSECOND_RAD
    in_arcsec = f'{rms_px * pixel_arcsec:.2f}″ at {pixel_arcsec:.1f}″ per pixel'
    refused = _none(sum(calibration.images_refused.values()))
    misfits = _none(len(calibration.misfit_images_ns))
    outliers = _none(calibration.stars_rejected)
    tiles = [
        ('Residual', f'{rms_px:.3f} px', f'rms per axis; {in_arcsec}'),
        (
            'Images',
            f'{calibration.images_used:,}',
            f'used; {refused} refused; attitude misfits among those used: {misfits}',
        ),
        ('Stars', f'{calibration.stars_used:,}', f'used; outliers left out: {outliers}'),
    ]
    maps = calibration.maps
    if maps is not None:
        for name, sigma, text in (
            ('Line of sight', maps.line_of_sight_sigma_arcsec, 'in the star tracker frame'),
            ('Camera alone', maps.shape_sigma_arcsec, 'common rotation removed'),
        ):
            note = f'1-sigma, rms over the detector, {text}; at most {sigma.max():.3g}″'
            tiles.append((name, f'{np.sqrt(np.mean(sigma**2)):.3g}″', note))
    return tiles


def _spread(count: int, most: int) -> list[int]:
    """Evenly spaced indices below a count, at most ``most``."""
    return [round(place) for place in np.linspace(0, count - 1, min(count, most)).tolist()]


def _slider(calibration: Calibration, residuals: Residuals | None) -> Mapping[str, object] | None:
    """Data of the single-image view: positions in px, residuals in 0.001 px."""
    if residuals is None or len(residuals.image_time_ns) == 0:
        return None
    camera, typical_px = calibration.geometry.camera, max(calibration.residual_rms_px, 1e-6)
    count = len(residuals.image_time_ns)
    mean_stars = max(1.0, len(residuals.image) / count)
    chosen = _spread(count, max(1, min(_SLIDER_IMAGES, int(_SLIDER_STARS / mean_stars))))
    rms = residuals.image_rms_px()
    images = []
    for k in chosen:
        here = residuals.image == k
        place = np.rint(residuals.measured_px[here]).astype(int)
        residual = np.rint(1000 * np.clip(residuals.residual_px[here], -99, 99)).astype(int)
        stars = np.c_[place, residual, residuals.used[here].astype(int)]
        error = residuals.attitude_error_arcsec[k]
        images.append(
            {
                'number': k + 1,
                'time': utc_text(int(residuals.image_time_ns[k])),
                'rms': None if math.isnan(rms[k]) else round(float(rms[k]), 4),
                'misfit': bool(residuals.image_misfit[k]),
                'tracker': [None if math.isnan(e) else round(float(e), 2) for e in error],
                'stars': stars.ravel().tolist(),
            }
        )
    return {
        'width': camera.width,
        'height': camera.height,
        'count': count,
        'images': images,
        # A typical residual is drawn as long as a fiftieth of the width.
        'enlarge': round(float(np.clip(np.log10(0.02 * camera.width / typical_px), 0, 4)), 1),
    }


def _picture(thumbnail: Thumbnail) -> Markup:
    """Data URL of a picture."""
    kind = 'image/jpeg' if thumbnail.name.endswith('.jpg') else 'image/png'
    # Safe as markup: base64 has no special characters.
    return Markup(f'data:{kind};base64,{base64.b64encode(thumbnail.encoded).decode("ascii")}')


def _refused_images(found: Found) -> list[Mapping[str, object]]:
    """For each reason: its count, the refused images and pictures of some."""
    pictures = {t.time_ns: t for t in found.thumbnails if not t.reason}
    groups: list[Mapping[str, object]] = []
    for reason, count in sorted(found.calibration.images_refused.items(), key=lambda i: -i[1]):
        images = [o for o in found.observations or () if o.refusal == reason]
        groups.append(
            {
                'reason': reason,
                'meaning': IMAGE_REFUSALS.get(reason, ''),
                'count': count,
                'images': [(utc_text(o.time_ns), o.detail) for o in images[:_LISTED_REFUSED]],
                'pictures': [
                    (_picture(pictures[o.time_ns]), utc_text(o.time_ns), o.detail)
                    for o in images
                    if o.time_ns in pictures
                ],
            }
        )
    return groups


def _counts(found: Found) -> Mapping[str, int]:
    """Refused stars of all images by reason."""
    counts: dict[str, int] = {}
    for observed in found.observations or ():
        for reason, count in observed.refused_stars.items():
            counts[reason] = counts.get(reason, 0) + count
    return counts


def _star_marks(found: Found) -> list[tuple[str, str]]:
    """Colour and reason of the marks of refused stars in the pictures."""
    return [
        ('#{:02x}{:02x}{:02x}'.format(*reversed(STAR_MARKS[reason].color)), reason)
        for reason, count in _counts(found).items()
        if count and reason in STAR_MARKS
    ]


def _cut_outs(found: Found, reason: str) -> list[tuple[Markup, str, str]]:
    """Pictures of stars refused for a reason, with the stamp and the catalog number of each."""
    by_time = {o.time_ns: o for o in found.observations or ()}
    cut_outs = []
    for one in found.thumbnails:
        if one.reason == reason:
            number = star_of(one, by_time[one.time_ns]) if one.time_ns in by_time else None
            label = '' if number is None else str(number)
            cut_outs.append((_picture(one), utc_text(one.time_ns), label))
    return cut_outs


def _refused_stars(found: Found) -> list[Mapping[str, object]]:
    return [
        {
            'reason': reason,
            'meaning': STAR_REFUSALS.get(reason, ''),
            'count': count,
            'pictures': _cut_outs(found, reason),
        }
        for reason, count in sorted(_counts(found).items(), key=lambda item: -item[1])
        if count
    ]


def _used_images(found: Found) -> list[tuple[Markup, str, int]]:
    stars = {o.time_ns: len(o) for o in found.observations or () if not o.refusal}
    return [
        (_picture(t), utc_text(t.time_ns), stars[t.time_ns])
        for t in found.thumbnails
        if not t.reason and t.time_ns in stars
    ]


def _provenance(calibration: Calibration) -> Mapping[str, object]:
    known = dict(calibration.provenance)
    options = _options_of(calibration)
    known.pop('options', None)
    known.pop('prior', None)
    return {
        'entries': sorted(known.items()),
        'options': sorted((name, json.dumps(value)) for name, value in options.items()),
    }
