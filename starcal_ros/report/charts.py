# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of the report and their captions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup
import numpy as np

from starcal_ros.assessment.residuals import Residuals
from starcal_ros.products.calibration_json import prior_of
from starcal_ros.records import Calibration, parts_that_matter, StarObservations
from starcal_ros.report import detector_figures, figures


@dataclass(frozen=True)
class Chart:
    """A figure with title and caption; the caption also describes it to screen readers."""

    title: str
    svg: Markup
    text: str


def charts_of(
    calibration: Calibration,
    residuals: Residuals | None,
    observations: Sequence[StarObservations],
) -> Mapping[str, Chart]:
    """Charts by their name in the template; charts without data are left out."""
    camera = calibration.geometry.camera
    charts = {
        'vectors': Chart(
            'Distortion vectors',
            detector_figures.distortion_vectors(camera),
            'Displacement of a star from its position with an ideal lens (dot). Arrows are '
            'enlarged; the arrow above the figure is their scale.',
        ),
        'contours': Chart(
            'Distortion magnitude',
            detector_figures.distortion_contours(camera),
            'Contours of the length of the distortion vectors; a longer one has a thicker line.',
        ),
    }
    if (field := camera.moving_field) is not None:
        charts['lens_field'] = Chart(
            'Residual field beside the lens model',
            detector_figures.field_vectors(field, camera),
            'Displacement of a star from its place by the lens model, enlarged to the scale of '
            'the arrow above the figure.',
        )
    prior = prior_of(calibration)
    if prior is not None:
        charts['change'] = Chart(
            'Change relative to the prior',
            detector_figures.change_contours(prior, calibration.geometry),
            'Change of the line of sight of each pixel relative to the prior, in pixels, with the '
            'common rotation removed.',
        )
    if calibration.maps is not None:
        maps = calibration.maps
        charts['cells'] = Chart(
            'Stars per cell',
            detector_figures.cell_counts(maps, camera),
            f'Used star observations in {maps.stars.size} equal cells: '
            f'{int(maps.stars.min())} to {int(maps.stars.max())} per cell, '
            f'{int((maps.stars == 0).sum())} cells empty.',
        )
        for name, title, sigma, text in (
            ('line_of_sight', 'Line of sight, camera and alignment',
             maps.line_of_sight_sigma_arcsec, 'in the star tracker frame'),
            ('shape', 'Line of sight, camera alone', maps.shape_sigma_arcsec,
             'with the rotation common to all pixels removed'),
        ):  # fmt: skip
            charts[name] = Chart(
                title,
                detector_figures.line_of_sight_sigma(sigma, camera),
                f'1-sigma of the line of sight of each pixel, {text}: '
                f'{sigma.min():.4g}″ to {sigma.max():.4g}″. The colours start at zero.',
            )
    if calibration.sigma_budget:
        charts['budget'] = Chart(
            'Causes of the uncertainty',
            figures.sigma_budget(parts_that_matter(calibration.sigma_budget)),
            'Share of the variance of a line of sight, over the detector, that would be gone if '
            'the cause were known exactly.',
        )
    if len(calibration.removals) > 1:
        insignificant = [r.removed for r in calibration.removals[1:] if r.negligible]
        charts['terms'] = Chart(
            'Significance of each term',
            figures.term_worth(calibration.removals),
            'Terms removed one after another, the least significant first, with all others '
            'estimated again. Not significant (shaded): '
            f'{", ".join(insignificant) or "none"}.',
        )
    sky, placed = detector_figures.pointings(observations, calibration.geometry)
    if placed:
        charts['sky'] = Chart(
            'Pointings',
            sky,
            f'Footprints of {placed} images on the whole sky (ICRS, Hammer projection, right '
            'ascension to the left).',
        )
    if residuals is not None and residuals.used.any():
        charts.update(_residual_charts(calibration, residuals))
        if prior is not None:
            before = figures.before_and_after(residuals, observations, prior)
            if before:
                charts['before'] = Chart(
                    'Residuals before and after',
                    before,
                    'Distance of the stars from their prediction: by the attitude that the star '
                    'tracker reported and the prior, and after the calibration.',
                )
    return charts


def _residual_charts(calibration: Calibration, residuals: Residuals) -> dict[str, Chart]:
    camera = calibration.geometry.camera
    rms = residuals.image_rms_px()
    charts = {
        'coverage': Chart(
            'Star positions',
            detector_figures.star_coverage(residuals, camera),
            f'All {int(residuals.used.sum()):,} used star observations of all images.',
        ),
        'images': Chart(
            'Residuals per image',
            figures.residuals_of_images(residuals),
            f'RMS per axis of each image: {np.nanmin(rms):.3f} to {np.nanmax(rms):.3f} px. A high '
            'value indicates smear or misidentified stars.',
        ),
        'field': Chart(
            'Mean residuals over the detector',
            detector_figures.mean_residuals(residuals, camera),
            'Mean residual of the stars in each cell, enlarged to the scale of the arrow above. A '
            'regular pattern indicates '
            'distortion that the lens model does not describe; noise has no pattern.',
        ),
        'spectrum': Chart(
            'Spectrum of the residuals',
            figures.spectrum(residuals, camera),
            'Waves that are left in the residuals over the detector. Amplitudes over the line of '
            'independent noise indicate a pattern that neither lens model nor field describes.',
        ),
        'histogram': Chart(
            'Normalised residuals',
            figures.histogram(residuals),
            'Each residual divided by its sigma. A standard deviation near 1 confirms the sigmas; '
            'outliers are left out, which truncates the tails.',
        ),
        'magnitude': Chart(
            'Residuals against magnitude',
            figures.residuals_against_magnitude(residuals),
            'Dots: single stars. Measured and expected noise agree where the two lines coincide.',
        ),
    }
    if not charts['magnitude'].svg:
        del charts['magnitude']  # no star has a magnitude
    colour = figures.residuals_against_colour(residuals)
    if colour:
        charts['colour'] = Chart(
            'Residuals against star colour',
            colour,
            'A trend indicates lateral colour of the lens, which displaces red from blue stars.',
        )
    charts['phase'] = Chart(
        'Residuals against pixel phase',
        figures.residuals_against_pixel_phase(residuals),
        'A wave indicates a centroid error: the star model does not fit.',
    )
    if np.isfinite(residuals.attitude_error_arcsec).any():
        charts['alignment'] = Chart(
            'Star tracker errors per image',
            figures.alignment_in_time(residuals, calibration.star_tracker_sigma_arcsec),
            'Difference between reported attitude and stars about the star tracker axes, at the '
            'common alignment; the band is the assumed 1-sigma. A drift indicates a moving mount; '
            'a cross is an image whose attitude does not fit and was not used.',
        )
    return charts
