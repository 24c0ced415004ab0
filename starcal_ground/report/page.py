# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Report of a calibration as one self-contained HTML file, ``report.html``, and pages to sign.

The report is made from the product files of a folder; a section whose file is missing states so.
The page needs no network: styles, script and pictures are embedded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import functools
import json
import logging
from pathlib import Path

import jinja2

from starcal_ground import products
from starcal_ground.outputs import OBSERVATIONS_FILE, REPORT_FILE
from starcal_ground.products import CAMERA_INFO_FILE
from starcal_ground.report import detector_figures, figures, page_sections, thumbnails, verdict
from starcal_ground.report.svg import Chart, light
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.constants import utc_text
from starcal_ros.errors import ProductError
from starcal_ros.estimation.problem import alignment_summary
from starcal_ros.estimation.temperature import summary as thermal_summary
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.message_codec import OBSERVATIONS_TYPE
from starcal_ros.formats.products import product_files
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.pipeline.provenance import inputs_of
from starcal_ros.records import Calibration, IMAGE_REFUSALS, parts_that_matter, StarObservations
from starcal_ros.text import significant
from starcal_ros.untrusted import json_value

_DIGEST = '@sha256 of {}@'  # in a page that is drawn while its products are written
_PRODUCTS = (
    product_files.CALIBRATION_FILE,
    CAMERA_INFO_FILE,
    products.RESIDUALS_FILE,
    OBSERVATIONS_FILE,
)
PDF_FILE = 'report.pdf'


@dataclass(frozen=True)
class Found:
    """
    Contents of a folder; ``residuals`` and ``observations`` are None without a file.

    ``pictures`` are in the order of `thumbnails.ordered`, ``files`` the names of the products
    beside the report.
    """

    calibration: Calibration
    residuals: Residuals | None
    observations: tuple[StarObservations, ...] | None
    pictures: tuple[thumbnails.Thumbnail, ...]
    files: tuple[str, ...] = _PRODUCTS


def write_report(folder: Path) -> Path:
    """
    Write ``report.html`` from the product files of a folder and return its path.

    In the state folder of a calibrator it is the page of the last calibration.  Where the last
    calibration into the folder failed, it is the page of that failure.  Raises ProductError,
    BagError when a file cannot be read or the report cannot be written.
    """
    failure = products.read_not_calibrated(folder)
    if failure is not None:
        return write_failure_page(failure, folder)
    path = folder / REPORT_FILE
    write_atomically(path, with_digests(render(_read_folder(folder), folder), folder))
    return path


def _read_folder(folder: Path) -> Found:
    residuals = folder / products.RESIDUALS_FILE
    observations, ensemble = folder / OBSERVATIONS_FILE, folder / product_files.STATE_ENSEMBLE
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
        tuple(name for name in _PRODUCTS if (folder / name).is_file()),
    )


def _observations(bag: Path) -> Iterator[StarObservations]:
    return reader.read_observations([bag], reader.choose_topic([bag], OBSERVATIONS_TYPE))


def with_digests(text: str, folder: Path) -> str:
    """The page of a folder with the SHA-256 digests of its products, which must be written."""
    for name in _PRODUCTS:
        if (folder / name).is_file():
            (digest,) = inputs_of([folder / name]).values()
            text = text.replace(_DIGEST.format(name), digest)
    return text


def render(found: Found, folder: Path) -> str:
    """
    HTML text of the report of a folder, for `with_digests`.

    Raises ProductError when the contents cannot be drawn.
    """
    try:
        return page_template('report.html').render(_context(found))
    # A file can hold numbers that no calibration has; the errors of drawing have no common base.
    except Exception as error:
        why = f'{type(error).__name__}: {error}'
        raise ProductError(f'{folder}: the products cannot be drawn: {why}') from error


def _context(found: Found) -> Mapping[str, object]:
    calibration, residuals, pictures = found.calibration, found.residuals, found.pictures
    observations = found.observations or ()
    prior = products.prior_of(calibration)
    refused = calibration.images_refused
    return {
        'calibration': calibration,
        'time': utc_text(calibration.time_ns),
        'active_since': utc_text(calibration.active_since_ns),
        'parameters': page_sections.parameter_rows(calibration, prior),
        'alignment': page_sections.alignment_rows(calibration, prior)
        if calibration.has_alignment
        else [],
        'tiles': page_sections.tiles(calibration),
        'checks': verdict.check_rows(calibration.gate),
        'checks_sentence': verdict.checks_sentence(calibration.gate),
        'precision': verdict.precision_sentences(calibration),
        'next_step': verdict.next_step(calibration),
        'signed': _signed(calibration),
        'star_trackers': [alignment_summary(one) for one in calibration.star_trackers],
        'thermal': thermal_summary(calibration.temperature) if calibration.temperature else '',
        'charts': charts_of(calibration, residuals, observations),
        'correlation': calibration.correlation,
        'slider': page_sections.slider(calibration, residuals),
        'refused_images': page_sections.refused_images(refused, observations, pictures),
        'refused_stars': page_sections.refused_stars(observations, pictures),
        'model_rows': verdict.model_rows(calibration),
        'star_marks': page_sections.star_marks(observations),
        'files': [(name, _DIGEST.format(name)) for name in found.files],
        'has_images': any(not one.reason for one in pictures),
        'used_images': page_sections.used_images(observations, pictures),
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
    return [
        ('calibration', f'{calibration.child_frame} on {calibration.parent_frame}'),
        ('images', f'{utc_text(calibration.first_image_ns)} to {utc_text(calibration.time_ns)}'),
        *sorted((name, value) for name, value in known if name not in ('options', 'prior')),
    ]


def write_failure_page(record: products.NotCalibrated, folder: Path) -> Path:
    """
    Write ``report.html`` of a failure and return its path.

    Raises ProductError when the page cannot be written.
    """
    pictures = [
        (page_sections.picture(one), utc_text(one.time_ns))
        for one in thumbnails.read_thumbnails(folder / thumbnails.THUMBNAILS_FOLDER)
        if one.reason == thumbnails.EXPECTED
    ]
    refused = [
        (count, reason, IMAGE_REFUSALS.get(reason, ''))
        for reason, count in record.images_refused.items()
    ]
    text = page_template('failure.html').render(record=record, pictures=pictures, refused=refused)
    path = folder / REPORT_FILE
    write_atomically(path, text)
    return path


def charts_of(
    calibration: Calibration, residuals: Residuals | None, observations: Sequence[StarObservations]
) -> Mapping[str, Chart]:
    """Charts by their name in the template; charts without data are left out."""
    geometry, prior = calibration.geometry, products.prior_of(calibration)
    camera, maps = geometry.camera, calibration.maps
    charts: dict[str, Chart | None] = {
        'vectors': detector_figures.distortion_vectors(camera),
        'contours': detector_figures.distortion_contours(camera),
        'sky': detector_figures.pointings(observations, geometry),
    }
    if prior is not None:
        charts['change'] = detector_figures.change_contours(prior, geometry)
    if (field := camera.moving_field) is not None:
        charts['lens_field'] = detector_figures.field_vectors(field, camera)
    if maps is not None:
        charts['cells'] = detector_figures.cell_counts(maps.stars, camera)
        charts['shape'] = detector_figures.line_of_sight_sigma(maps, camera, is_alone=True)
        charts['line_of_sight'] = detector_figures.line_of_sight_sigma(maps, camera, False)
    if calibration.sigma_budget:
        parts = parts_that_matter(calibration.sigma_budget)
        charts['budget'] = figures.sigma_budget(parts, calibration.has_alignment)
        charts['causes'] = detector_figures.budget_over_detector(parts, camera)
    if residuals is not None and residuals.used.any():
        charts |= _residual_charts(calibration, residuals)
        if prior is not None:
            charts['before'] = figures.before_and_after(residuals, observations, prior)
    return {name: chart for name, chart in charts.items() if chart is not None}


def _residual_charts(calibration: Calibration, residuals: Residuals) -> dict[str, Chart | None]:
    camera = calibration.geometry.camera
    sigma_arcsec = calibration.star_tracker_sigma_arcsec
    return {
        'coverage': detector_figures.star_coverage(residuals, camera),
        'images': figures.residuals_of_images(residuals),
        'field': detector_figures.mean_residuals(residuals, camera),
        'spectrum': figures.spectrum(residuals, camera),
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
    environment.filters['significant'] = significant
    return environment.get_template(name)


def write_pdf(page: Path) -> Path:
    """
    Write the pages of a report beside it and return their path.

    Raises ProductError when the libraries that draw the letters are missing, or the file cannot be
    written.
    """
    try:
        import weasyprint
    except OSError as error:
        raise ProductError(
            f'{PDF_FILE}: the library Pango is missing ({str(error).splitlines()[0]}): '
            'apt install libpango-1.0-0 libpangoft2-1.0-0'
        ) from error
    logging.getLogger('weasyprint').setLevel(logging.ERROR)  # styles of the screen alone
    within_page = weasyprint.URLFetcher(allowed_protocols=('data',))
    document = weasyprint.HTML(string=light(page.read_text()), url_fetcher=within_page)
    path = page.with_name(PDF_FILE)
    write_atomically(path, document.write_pdf())
    return path
