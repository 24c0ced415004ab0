# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of the report: residuals, terms, and the causes of the sigma."""

from __future__ import annotations

from collections.abc import Sequence
import functools
import math

import numpy as np

from starcal_ground.report import svg
from starcal_ground.residuals import Residuals
from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.estimation.star_equations import whitening
from starcal_ros.pipeline.annotation import predicted_px
from starcal_ros.records import CameraGeometry, SigmaPart, StarObservations
from starcal_ros.text import significant

_LEAST_IN_BIN = 10


def residuals_of_images(residuals: Residuals) -> svg.Chart:
    """RMS residual of the used stars of each image, in time order."""
    rms = residuals.image_rms_px()
    number = np.arange(1, len(rms) + 1)
    stars = np.bincount(residuals.image[residuals.used], minlength=len(rms))
    titles = [
        f'image {n}: {r:.4f} px rms, {s} stars' for n, r, s in zip(number, rms, stars, strict=True)
    ]
    return svg.Chart(
        'Residuals per image',
        svg.plot([svg.Curve(number, rms, svg.SERIES[0], mark='circle', width=0, titles=titles)],
                 'image', 'residual, rms per axis (px)', y=(0.0, None)),
        f'RMS per axis of each image: {np.nanmin(rms):.3f} to {np.nanmax(rms):.3f} px. A high '
        'value indicates smear or misidentified stars.',
    )  # fmt: skip


def outline(values: Floats, edges: Floats, colour: str, name: str) -> svg.Curve:
    """Histogram of a density, as the outline of its bars; values outside are in the end bins."""
    density, _ = np.histogram(np.clip(values, *edges[[0, -1]]), edges, density=True)
    return svg.Curve(np.repeat(edges, 2)[1:-1], np.repeat(density, 2), colour, name)


def histogram(residuals: Residuals) -> svg.Chart:
    """Normalised residuals and the normal distribution (paper, Fig. 7)."""
    edges, x = np.linspace(-5, 5, 51, dtype=np.float64), np.linspace(-5, 5, 201)
    uu, uv, vv = whitening(residuals.covariance_px2[residuals.used])
    r_u, r_v = residuals.residual_px[residuals.used].T
    curves = [
        outline(values, edges, colour, f'{axis}: std {values.std():.2f}')
        for values, colour, axis in zip(
            (uu * r_u + uv * r_v, vv * r_v), svg.SERIES, 'uv', strict=False
        )
    ]
    normal = np.exp(-0.5 * x**2) / math.sqrt(2 * math.pi)
    curves.append(svg.Curve(x, normal, svg.INK, 'normal', width=1.0, dash='5 3'))
    return svg.Chart(
        'Normalised residuals',
        svg.plot(curves, 'normalised residual (sigma)', 'density', x=(-5.0, 5.0), y=(0.0, None)),
        'Each residual divided by its sigma. A standard deviation near 1 confirms the sigmas; '
        'outliers are left out, which truncates the tails.',
    )


def before_and_after(
    residuals: Residuals, observations: Sequence[StarObservations], prior: CameraGeometry
) -> svg.Chart | None:
    """Share of the stars within a distance of their prediction, by the prior and now; log axis."""
    before = [
        np.hypot(*(image.measured_px - predicted_px(image, prior)).T)
        for image in observations
        if not image.refusal
    ]
    before_px = np.concatenate(before or [np.empty(0)])
    before_px = np.sort(before_px[np.isfinite(before_px)])
    after_px = np.sort(np.hypot(*residuals.residual_px[residuals.used].T))
    if not (len(before_px) and len(after_px)):
        return None
    low = max(1e-4, float(np.quantile(after_px, 0.02)))
    curves = []
    for name, values, colour in (('prior', before_px, svg.SERIES[1]),
                                 ('calibrated', after_px, svg.SERIES[0])):  # fmt: skip
        at = np.linspace(0, len(values) - 1, min(len(values), 200)).astype(int)
        share = 100.0 * (at + 1) / len(values)
        name = f'{name}: median {significant(float(np.median(values)), 3)} px'
        curves.append(svg.Curve(np.maximum(values[at], low), share, colour, name, width=1.8))
    return svg.Chart(
        'Residuals before and after',
        svg.plot(curves, 'distance from the prediction (px)', 'stars within it (%)', x=(low, None),
                 y=(0.0, 100.0), log='x', is_left=True),
        'Distance of the stars from their prediction: by the attitude of the image and the prior, '
        'and after the calibration.',
    )  # fmt: skip


def residuals_against_magnitude(residuals: Residuals) -> svg.Chart | None:
    """Residuals against V magnitude, with the RMS in bins and the expected sigma."""
    used = residuals.used & np.isfinite(residuals.magnitude)
    V, r = residuals.magnitude[used], residuals.residual_px[used]
    if not len(V):
        return None
    # All per axis, so that points, measured RMS and expected sigma are comparable.
    length_px = np.sqrt((r**2).mean(axis=1))
    variance_px2 = residuals.covariance_px2[used][:, [0, 2]].mean(axis=1)
    first = float(np.floor(2 * V.min()) / 2)
    edges = np.arange(first, max(V.max(), first + 0.5) + 0.5, 0.5)
    centre, measured_px2 = _in_bins(np.r_[V, V], r.T.ravel() ** 2, edges)[:2]
    at, expected_px2 = _in_bins(V, variance_px2, edges)[:2]
    curves = [
        svg.Curve(centre, np.sqrt(measured_px2), svg.SERIES[1], 'measured rms', 'circle'),
        svg.Curve(at, np.sqrt(expected_px2), svg.INK, 'expected 1-sigma', width=1.4, dash='5 3'),
    ]
    top = 1.15 * float(np.percentile(length_px, 99.5)) + 1e-6
    drawn = svg.plot(
        curves, 'magnitude V', 'residual, rms of u and v (px)', x=(first, float(edges[-1])),
        y=(0.0, top), is_left=True,
        under=lambda panel: panel.cloud(np.c_[V, length_px], 1.0, 0.35),
    )  # fmt: skip
    return svg.Chart(
        'Residuals against magnitude',
        drawn,
        'Dots: single stars. Measured and expected noise agree where the two lines coincide.',
    )


def _in_bins(x: Floats, values: Floats, edges: Floats) -> tuple[Floats, Floats, Floats]:
    """Centres, means and standard errors of the mean in the bins with enough values."""
    inside = (x >= edges[0]) & (x <= edges[-1])
    which = np.minimum(np.searchsorted(edges, x[inside], side='right'), len(edges) - 1) - 1
    count = np.bincount(which, minlength=len(edges) - 1)
    enough = count >= _LEAST_IN_BIN
    n = count[enough]
    mean = np.bincount(which, values[inside], len(edges) - 1)[enough] / n
    square = np.bincount(which, values[inside] ** 2, len(edges) - 1)[enough] / n
    error = np.sqrt(np.maximum(square - mean**2, 0.0) / n)
    return 0.5 * (edges[1:] + edges[:-1])[enough], mean, error


def _means(x: Sequence[Floats], y: Floats, edges: Floats, label: str,
           names: Sequence[str]) -> svg.Drawing:  # fmt: skip
    """Means of u and v, y (2, n), with their standard errors in bins of x, about zero."""
    curves = [svg.Curve(edges[[0, -1]], [0.0, 0.0], svg.MUTED, width=0.8)]
    for side, mark in enumerate(('circle', 'square')):
        centre, mean, error = _in_bins(x[side], y[side], edges)
        at = centre + (side - 0.5) * 0.12 * (edges[1] - edges[0])
        curves.append(
            svg.Curve(at, mean, svg.SERIES[side], names[side], mark, width=0, sigma=error)
        )
    ends = float(edges[0]), float(edges[-1])
    return svg.plot(curves, label, 'mean residual (px), 1-sigma bars', x=ends)


def residuals_against_colour(residuals: Residuals) -> svg.Chart | None:
    """Mean residual against BP - RP, which shows dispersed light; None if too few colours."""
    used = residuals.used & np.isfinite(residuals.colour_bp_rp)
    if np.count_nonzero(used) < 30:
        return None
    colour = residuals.colour_bp_rp[used]
    low, high = np.percentile(colour, [1.0, 99.0]).tolist()
    if not high > low:
        return None
    edges, residual_px = np.linspace(low, high, 9, dtype=np.float64), residuals.residual_px[used].T
    return svg.Chart(
        'Residuals against star colour',
        _means([colour, colour], residual_px, edges, 'colour BP \N{MINUS SIGN} RP (mag)', 'uv'),
        'A trend indicates that the air or a prism displaces red from blue stars.',
    )


def residuals_against_pixel_phase(residuals: Residuals) -> svg.Chart:
    """Mean residual in u and v against the position of the centroid within its pixel."""
    place = residuals.measured_px[residuals.used].T
    edges = np.linspace(-0.5, 0.5, 11, dtype=np.float64)
    residual_px, label = residuals.residual_px[residuals.used].T, 'position within the pixel (px)'
    names = [f'{letter} against {letter}' for letter in 'uv']
    return svg.Chart(
        'Residuals against pixel phase',
        _means([*(place - np.rint(place))], residual_px, edges, f'centroid {label}', names),
        'A wave indicates a centroid error: the star model does not fit.',
    )


def alignment_in_time(residuals: Residuals, sigma_arcsec: Sequence[float]) -> svg.Chart | None:
    """Star tracker error of each image about the three tracker axes; None without attitudes."""
    if not np.isfinite(residuals.attitude_error_arcsec).any():
        return None
    minutes = (residuals.image_time_ns - residuals.image_time_ns.min()) / (
        60.0 * NANOSECONDS_PER_SECOND
    )
    misfit = residuals.image_misfit
    errors = residuals.attitude_error_arcsec.T
    tops = [
        1.25 * max(float(np.nanmax(np.abs(error[~misfit]), initial=0.0)), sigma) or 1.0
        for error, sigma in zip(errors, sigma_arcsec, strict=True)
    ]
    ticks = [[(k * step, svg.in_digits(k * step)) for k in (-1, 0, 1)]
             for step in (svg.round_step(top / 2.5) for top in tops)]  # fmt: skip
    letters = max(len(name) for of_axis in ticks for _, name in of_axis)
    panels = []
    for k, axis in enumerate('xyz'):
        error, sigma, top = errors[k], sigma_arcsec[k], tops[k]
        fitting = np.where(misfit, np.nan, error)
        curves = [
            svg.Curve(minutes, fitting, svg.SERIES[0], mark='circle', width=0,
                      sigma=residuals.attitude_sigma_arcsec[:, k]),
            svg.Curve(minutes, np.where(misfit, error, np.nan), svg.SERIES[1], mark='cross',
                      width=0),
        ]  # fmt: skip
        panels.append(
            svg.plot(curves, 'time since the first image (min)' * (axis == 'z'),
                     f'{axis} (arcsec)', y=(-top, top), y_ticks=ticks[k], letters=letters,
                     height=128.0 + 36.0 * (axis == 'z'),
                     under=functools.partial(svg.Panel.band, low=-sigma, high=sigma))
        )  # fmt: skip
    return svg.Chart(
        'Star tracker errors per image',
        svg.sheet([[panel] for panel in panels]),
        'Difference between reported attitude and stars about the star tracker axes, at the '
        'common alignment; the band is the assumed 1-sigma. A drift indicates a moving mount; '
        'a cross is an image whose attitude does not fit and was not used.',
    )


def sigma_budget(parts: Sequence[SigmaPart], has_alignment: bool) -> svg.Chart:
    """Share of the variance by cause as horizontal bars; the first part is the total."""
    total, causes = parts[0], parts[1:]
    bars = 2 if has_alignment else 1
    curves = []
    for k, part in enumerate(causes):
        for name, colour, sigma, whole, shift in (
            ('camera alone', svg.SERIES[0], part.map_arcsec, total.map_arcsec, -0.14),
            ('with alignment', svg.SERIES[1], part.pointing_arcsec, total.pointing_arcsec, 0.14),
        )[:bars]:
            end = 100.0 * (sigma / whole) ** 2
            at = -k - shift
            curves.append(svg.Curve([0.0, end], [at, at], colour, '' if k else name, width=8.0))
    names = [(-float(k), part.cause) for k, part in enumerate(causes)]
    height = max(340.0, 100.0 + 34.0 * len(causes))
    return svg.Chart(
        'Causes of the uncertainty',
        svg.plot(curves, 'share of the variance (%)', '', x=(0.0, 100.0),
                 y=(0.5 - len(causes), 1.2), y_ticks=names, height=height),
        'Share of the variance of a line of sight, over the detector, that would be gone if '
        'the cause were known exactly.',
    )  # fmt: skip
