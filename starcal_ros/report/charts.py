"""Which figures the report shows, and the words that go with each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup
import numpy as np

from starcal_ros.assessment.residuals import Residuals
from starcal_ros.products.calibration_json import prior_of
from starcal_ros.records import Calibration
from starcal_ros.report import figures


@dataclass(frozen=True)
class Chart:
    """A figure with its caption; ``text`` says in words what the drawing shows."""

    title: str
    svg: Markup
    text: str


def charts_of(calibration: Calibration, residuals: Residuals | None) -> Mapping[str, Chart]:
    """Charts by the name that the template places them by; those without data are left out."""
    camera = calibration.geometry.camera
    charts = {
        'vectors': Chart(
            'Distortion, as arrows',
            figures.distortion_vectors(camera),
            'Where the lens puts a star, seen from where an ideal lens would (dot); arrows are '
            'enlarged, the key gives their scale.',
        ),
        'contours': Chart(
            'Distortion, in pixels',
            figures.distortion_contours(camera),
            'Lines of equal length of those arrows.',
        ),
    }
    prior = prior_of(calibration)
    if prior is not None:
        charts['change'] = Chart(
            'Change against the prior',
            figures.change_contours(prior, calibration.geometry),
            'How far the line of sight of a pixel has moved from where the prior had it, a turn '
            'common to all pixels removed.',
        )
    if calibration.maps is not None:
        maps = calibration.maps
        charts['cells'] = Chart(
            'Stars in each cell',
            figures.cell_counts(maps, camera),
            f'Star observations used in {maps.stars.size} equal cells: '
            f'{int(maps.stars.min())} to {int(maps.stars.max())}, '
            f'{int((maps.stars == 0).sum())} of the cells empty.',
        )
        for name, title, sigma, text in (
            ('line_of_sight', 'Line of sight, camera and alignment',
             maps.line_of_sight_sigma_arcsec, 'in the star tracker frame'),
            ('shape', 'Line of sight, camera alone', maps.shape_sigma_arcsec,
             'after the turn that is common to all pixels'),
        ):  # fmt: skip
            charts[name] = Chart(
                title,
                figures.line_of_sight_sigma(sigma, camera, name),
                f'1-sigma of the direction that a pixel looks in, {text}: '
                f'{sigma.min():.3g}″ to {sigma.max():.3g}″. Each colour is an eighth of the '
                'detector.',
            )
    if len(calibration.removals) > 1:
        dropped = [r.removed for r in calibration.removals[1:] if r.negligible]
        charts['terms'] = Chart(
            'What each term is worth',
            figures.term_worth(calibration.removals),
            'Terms left out one after the other, the least missed first; all others are solved '
            'again. Within chance (shaded): ' + (', '.join(dropped) or 'none') + '.',
        )
    if residuals is not None and residuals.used.any():
        charts.update(_residual_charts(calibration, residuals))
    return charts


def _residual_charts(calibration: Calibration, residuals: Residuals) -> dict[str, Chart]:
    camera = calibration.geometry.camera
    rms = residuals.image_rms_px()
    charts = {
        'coverage': Chart(
            'Where the stars stood',
            figures.star_coverage(residuals, camera),
            f'All {int(residuals.used.sum()):,} star observations used, of all images.',
        ),
        'images': Chart(
            'Image by image',
            figures.residuals_of_images(residuals),
            f'RMS per axis of each image: {np.nanmin(rms):.3f} to {np.nanmax(rms):.3f} px. One '
            'that stands out was smeared, or its stars are wrong.',
        ),
        'field': Chart(
            'Over the detector',
            figures.residual_field(residuals, camera),
            'Mean residual of the stars in a cell, enlarged. Arrows that go together show what '
            'the model of the lens does not follow; noise has no order.',
        ),
        'histogram': Chart(
            'Against the normal distribution',
            figures.histogram(residuals),
            'Each residual over its own sigma. A standard deviation near 1 says that the sigmas '
            'are true; the ends are cut where outliers are left out.',
        ),
        'magnitude': Chart(
            'Against magnitude',
            figures.residuals_against_magnitude(residuals),
            'Dots: single stars. The measured line lies on the expected one where the noise is '
            'understood.',
        ),
    }
    colour = figures.residuals_against_colour(residuals)
    if colour:
        charts['colour'] = Chart(
            'Against the colour of the star',
            colour,
            'A trend is lateral colour of the lens: red and blue stars stand elsewhere.',
        )
    charts['phase'] = Chart(
        'Against the place in the pixel',
        figures.residuals_against_pixel_phase(residuals),
        'A wave is an error of the centroids: a model of the star that does not fit.',
    )
    if np.isfinite(residuals.attitude_error_arcsec).any():
        charts['alignment'] = Chart(
            'Star tracker against the stars, image by image',
            figures.alignment_in_time(residuals, calibration.star_tracker_sigma_arcsec),
            'About the axes of the star tracker, from the common alignment; the band is its '
            '1-sigma as used. A drift is a mounting that moves; a cross is an image whose '
            'attitude does not fit and that was not let pull.',
        )
    return charts
