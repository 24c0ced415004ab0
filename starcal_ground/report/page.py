# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Report of a calibration as one self-contained HTML file, ``report.html``, and pages to sign.

The report is made from the product files of a folder; a section whose file is missing states so.
The page needs no network: styles, script and pictures are embedded.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import functools
import json
from pathlib import Path

import cv2
import jinja2
from markupsafe import Markup

from starcal_ground import products, written_files
from starcal_ground.bags import reader
from starcal_ground.report import detector_figures, figures, svg, thumbnails, verdict
from starcal_ground.report.thumbnails import Thumbnail
from starcal_ground.residuals import Residuals
from starcal_ros.constants import ARCSECOND_RAD, utc_text
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.formats.messages.message_codec import OBSERVATIONS_TYPE
from starcal_ros.formats.products import product_files
from starcal_ros.pipeline import annotation
from starcal_ros.record_fields import nearest
from starcal_ros.records import (
    Calibration,
    IMAGE_REFUSALS,
    PIXELS_OF,
    STAR_REFUSALS,
    StarObservations,
    TIMES,
    TOTAL,
)
from starcal_ros.text import significant
from starcal_ros.untrusted import json_value

# Shape of a mark -> a letter like it.
_LETTERS = {
    cv2.MARKER_TRIANGLE_DOWN: '\N{WHITE DOWN-POINTING TRIANGLE}',
    cv2.MARKER_TRIANGLE_UP: '\N{WHITE UP-POINTING TRIANGLE}',
    cv2.MARKER_SQUARE: '\N{WHITE SQUARE}',
    cv2.MARKER_DIAMOND: '\N{WHITE DIAMOND}',
    cv2.MARKER_TILTED_CROSS: '\N{MULTIPLICATION SIGN}',
    cv2.MARKER_CROSS: '+',
    cv2.MARKER_STAR: '*',
}


def _none(count: int) -> str:
    return f'{count:,}' if count else 'none'


def tiles(calibration: Calibration) -> list[tuple[str, str, str]]:
    """(name, number, note) of the main results."""
    rms_px = calibration.residual_rms_px
    pixel_arcsec = 1.0 / calibration.geometry.camera.parameters[0] / ARCSECOND_RAD
    in_arcsec = f'{rms_px * pixel_arcsec:.2f}″ at {pixel_arcsec:.1f}″ per pixel'
    refused = _none(sum(calibration.images_refused.values()))
    misfits = f'; attitude misfits among those used: {_none(len(calibration.misfit_images_ns))}'
    outliers = _none(calibration.stars_rejected)
    results = [
        ('Residual', f'{rms_px:.3f} px', f'rms per axis; {in_arcsec}'),
        (
            'Images',
            f'{calibration.images_used:,}',
            f'used; {refused} refused{misfits if calibration.has_alignment else ""}',
        ),
        ('Stars', f'{calibration.stars_used:,}', f'used; outliers left out: {outliers}'),
    ]
    maps = calibration.maps
    if maps is not None:
        total = next((part for part in calibration.sigma_budget if part.cause == TOTAL), None)
        scopes = (
            ('Line of sight', maps.line_of_sight_sigma_arcsec,
             total.pointing_arcsec if total else None, 'in the star tracker frame'),
            ('Camera alone', maps.shape_sigma_arcsec, total.map_arcsec if total else None,
             'common rotation removed'),
        )  # fmt: skip
        for name, sigma, rms, text in scopes if calibration.has_alignment else scopes[1:]:
            worst = f'at most {significant(sigma.max(), 3)}″'
            if rms is None:
                results.append((name, worst, f'1-sigma, {text}'))
            else:
                note = f'1-sigma, rms over the detector, {text}; {worst}'
                results.append((name, f'{significant(rms, 2)}″', note))
    return results


def data_url(thumbnail: Thumbnail) -> Markup:
    """Data URL of a picture."""
    kind = 'image/jpeg' if thumbnail.name.endswith('.jpg') else 'image/png'
    # Safe as markup: base64 has no special characters.
    return Markup(f'data:{kind};base64,{base64.b64encode(thumbnail.encoded).decode("ascii")}')


def star_mark(reason: str) -> tuple[str, str] | None:
    """Colour and letter of the mark of refused stars in the pictures; None without a mark."""
    mark = annotation.STAR_MARKS.get(reason)
    if mark is None:
        return None
    blue, green, red = mark.color
    return f'#{red:02x}{green:02x}{blue:02x}', _LETTERS[mark.shape]


@dataclass(frozen=True)
class Found:
    """
    Contents of a folder; ``residuals`` and ``observations`` are None without a file.

    ``pictures`` are in the order of `thumbnails.ordered`.
    """

    calibration: Calibration
    residuals: Residuals | None
    observations: tuple[StarObservations, ...] | None
    pictures: tuple[Thumbnail, ...]


def write_report(folder: Path) -> Path:
    """
    Write ``report.html`` from the product files of a folder and return its path.

    In the state folder of a calibrator it is the page of the active one.  Where the last
    calibration into the folder failed, it is the page of that failure.  Raises ProductError,
    BagError when a file cannot be read or the report cannot be written.
    """
    failure = products.read_not_calibrated(folder)
    if failure is not None:
        return write_failure_page(failure, folder)
    path = folder / products.REPORT_FILE
    written_files.write_marked(path, render(_read_folder(folder), folder))
    return path


def _read_folder(folder: Path) -> Found:
    residuals = folder / products.RESIDUALS_FILE
    observations, ensemble = (
        folder / products.OBSERVATIONS_FILE,
        folder / product_files.STATE_ENSEMBLE,
    )
    calibration = product_files.read_calibration(product_files.calibration_file(folder))
    recorded = None
    if observations.is_file():
        recorded = tuple(_observations(observations))
    elif any(ensemble.glob('*.mcap')):  # it may have grown since
        span_ns = range(calibration.first_image_ns, calibration.time_ns + 1)
        recorded = tuple(image for image in _observations(ensemble) if image.time_ns in span_ns)
    return Found(
        calibration,
        products.read_residuals(residuals) if residuals.is_file() else None,
        recorded,
        thumbnails.read_thumbnails(folder / thumbnails.THUMBNAILS_FOLDER),
    )


def _observations(bag: Path) -> Iterator[StarObservations]:
    return reader.read_observations([bag], reader.choose_topic([bag], OBSERVATIONS_TYPE))


def render(contents: Found, folder: Path) -> str:
    """
    HTML text of the report of a folder, whose products must be written: it has their digests.

    Raises ProductError when the contents cannot be drawn.
    """
    try:
        return page_template('report.html').render(_context(contents, folder))
    # A file can hold numbers that no calibration has; the errors of drawing have no common base.
    except Exception as error:
        why = f'{type(error).__name__}: {error}'
        raise ProductError(f'{folder}: the products cannot be drawn: {why}') from error


def _context(contents: Found, folder: Path) -> Mapping[str, object]:
    calibration, residuals, pictures = contents.calibration, contents.residuals, contents.pictures
    observations = contents.observations or ()
    prior = products.prior_of(calibration)
    written = [
        name
        for name in products.PRODUCT_FILES
        if name != products.REPORT_FILE and (folder / name).is_file()
    ]
    return {
        'calibration': calibration,
        'times_of': calibration.provenance.get(TIMES, ''),
        'pixels_of': calibration.provenance.get(PIXELS_OF, ''),
        'parameters': verdict.parameter_rows(calibration, prior),
        'alignment': verdict.alignment_rows(calibration, prior),
        'tiles': tiles(calibration),
        'checks': verdict.check_rows(calibration.gate),
        'checks_sentence': verdict.checks_sentence(calibration.gate),
        'sentences': verdict.in_sentences(calibration),
        'signed': _signed(calibration),
        'star_trackers': [verdict.alignment_summary(one) for one in calibration.star_trackers],
        'thermal': verdict.thermal_summary(calibration.temperature)
        if calibration.temperature
        else '',
        'charts': charts_of(calibration, residuals, observations),
        'correlation': calibration.correlation,
        'observations': observations,
        'refused_images': Counter(calibration.images_refused).most_common(),
        'refused_stars': [*products.refused_stars(observations).items()],
        'model_sentences': verdict.model_sentences(calibration),
        'files': [(name, *products.inputs_of([folder / name]).values()) for name in written],
        'pictures': {one.time_ns: one for one in pictures if not one.is_expected},
        'options': _options(calibration),
    }


def _options(calibration: Calibration) -> list[tuple[str, str]]:
    try:
        options = json_value(calibration.provenance['options'])
    except (KeyError, ValueError):
        return []
    known = options if isinstance(options, dict) else {}
    return sorted((name, json.dumps(value)) for name, value in known.items())


def _signed(calibration: Calibration) -> list[tuple[str, str]]:
    """Rows above a signature: names, times, and the provenance with its digests."""
    known = calibration.provenance.items()
    frames = filter(None, (calibration.child_frame, calibration.parent_frame))
    return [
        ('calibration', ' on '.join(frames)),
        ('images', f'{utc_text(calibration.first_image_ns)} to {utc_text(calibration.time_ns)}'),
        *sorted((name, value) for name, value in known if name not in ('options', 'prior')),
    ]


def write_failure_page(record: products.NotCalibrated, folder: Path) -> Path:
    """
    Write ``report.html`` of a failure and return its path.

    Raises ProductError when the page cannot be written.
    """
    pictures = thumbnails.read_thumbnails(folder / thumbnails.THUMBNAILS_FOLDER)
    text = page_template('failure.html').render(record=record, pictures=pictures)
    path = folder / products.REPORT_FILE
    written_files.write_marked(path, text)
    return path


def plot(
    source: Calibration | Path | str,
    name: str,
    residuals: Residuals | None = None,
    observations: Sequence[StarObservations] = (),
) -> svg.Chart:
    """
    Figure of the report by its name, such as ``shape``, ``budget`` or ``histogram``, as SVG.

    A notebook shows it; ``svg.document()`` is the text of a file.  ``source`` is a folder of
    products, or a calibration with its residuals and observations, which some figures need.
    Raises OptionError with the names that there are.

    Examples
    --------
    >>> import starcal_ground
    >>> figure = starcal_ground.plot('out', 'budget')
    >>> figure.title, figure.svg.document()[:4]
    ('Causes of the uncertainty', '<svg')
    """
    if not isinstance(source, Calibration):
        read = _read_folder(Path(source))
        source, residuals, observations = read.calibration, read.residuals, read.observations or ()
    charts = charts_of(source, residuals, observations)
    if name not in charts:
        raise OptionError(f'{name!r} is not one of {", ".join(charts)}{nearest(name, charts)}')
    return charts[name]


def charts_of(
    calibration: Calibration, residuals: Residuals | None, observations: Sequence[StarObservations]
) -> Mapping[str, svg.Chart]:
    """Charts by their name in the template; charts without data are left out."""
    geometry, prior = calibration.geometry, products.prior_of(calibration)
    camera, maps = geometry.camera, calibration.maps
    charts: dict[str, svg.Chart | None] = {
        'vectors': detector_figures.distortion_vectors(camera),
        'sky': detector_figures.pointings(observations, geometry),
    }
    if prior is not None:
        charts['change'] = detector_figures.change_from_prior(prior, geometry)
    if (field := camera.moving_field) is not None:
        charts['lens_field'] = detector_figures.field_vectors(field, camera)
    if maps is not None:
        charts['cells'] = detector_figures.cell_counts(maps.stars, camera)
        charts['shape'] = detector_figures.line_of_sight_sigma(maps, camera, is_alone=True)
        if calibration.has_alignment:
            charts['line_of_sight'] = detector_figures.line_of_sight_sigma(maps, camera, False)
    if calibration.sigma_budget:
        parts = verdict.parts_that_matter(calibration.sigma_budget)
        charts['budget'] = figures.sigma_budget(parts, calibration.has_alignment)
    if residuals is not None and residuals.used.any():
        charts |= _residual_charts(calibration, residuals)
        if prior is not None:
            charts['before'] = figures.before_and_after(residuals, observations, prior)
    return {name: chart for name, chart in charts.items() if chart is not None}


def _residual_charts(
    calibration: Calibration, residuals: Residuals
) -> dict[str, svg.Chart | None]:
    camera = calibration.geometry.camera
    sigma_arcsec = calibration.star_tracker_sigma_arcsec
    return {
        'images': figures.residuals_of_images(residuals),
        'field': detector_figures.mean_residuals(residuals, camera),
        'histogram': figures.histogram(residuals),
        'magnitude': figures.residuals_against_magnitude(residuals),
        'colour': figures.residuals_against_colour(residuals),
        'phase': figures.residuals_against_pixel_phase(residuals),
        'alignment': figures.alignment_in_time(residuals, sigma_arcsec),
    }


@functools.cache
def page_template(name: str) -> jinja2.Template:
    """Template of a page, compiled at the first call; text is escaped, a missing name raises."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('starcal_ground.report'),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {'significant': significant, 'utc': utc_text, 'data_url': data_url}
    environment.globals |= {
        'IMAGE_REFUSALS': IMAGE_REFUSALS,
        'STAR_REFUSALS': STAR_REFUSALS,
        'star_mark': star_mark,
    }
    return environment.get_template(name)
