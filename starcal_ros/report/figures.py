# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of the report about residuals and terms, as SVG."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math

from markupsafe import Markup
import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.camera import CameraModel
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.estimation.star_equations import whitening
from starcal_ros.records import CameraGeometry, SigmaPart, StarObservations, TermRemoval
from starcal_ros.report import svg
from starcal_ros.report.pictures.annotation import predicted_px
from starcal_ros.report.svg import INK, MUTED, Panel, Scale, SERIES

_LEFT, _RIGHT, _TOP, _BELOW = 62.0, 468.0, 10.0, 42.0
_HEIGHT = 340.0
_LEAST_IN_BIN = 10
_WAVES = 16  # highest spatial frequency of the spectrum, waves over the longer side


def _panel(x: tuple[float, float], y: tuple[float, float], is_log: bool = False) -> Panel:
    return Panel(Scale(*x, _LEFT, _RIGHT), Scale(*y, _HEIGHT - _BELOW, _TOP, is_log))


def residuals_of_images(residuals: Residuals) -> Markup:
    """RMS residual of the used stars of each image, in time order."""
    rms = residuals.image_rms_px()
    number = np.arange(1, len(rms) + 1)
    stars = np.bincount(residuals.image[residuals.used], minlength=len(rms))
    top = 1.15 * float(np.nanmax(rms, initial=0.0)) or 1.0
    panel = _panel((0.5 - 0.02 * len(rms), len(rms) + 0.5 + 0.02 * len(rms)), (0.0, top))
    panel.axes('image', 'residual, rms per axis (px)')
    titles = [
        f'image {n}: {r:.4f} px rms, {s} stars' for n, r, s in zip(number, rms, stars, strict=True)
    ]
    panel.marks(number, rms, SERIES[0], titles=titles)
    return svg.chart([panel], _HEIGHT)


def histogram(residuals: Residuals) -> Markup:
    """Normalised residuals and the normal distribution (paper, Fig. 7)."""
    edges = np.linspace(-5, 5, 51)
    x = np.linspace(-5, 5, 201)
    normal = np.exp(-0.5 * x**2) / math.sqrt(2 * math.pi)
    counted = []
    for values in whitened_residuals(residuals):
        density, _ = np.histogram(np.clip(values, -4.999, 4.999), edges, density=True)
        counted.append((density, float(values.std())))
    top = 1.1 * max(0.4, *(float(density.max()) for density, _ in counted))
    panel = _panel((-5.0, 5.0), (0.0, top))
    panel.axes('normalised residual (sigma)', 'density')
    for (density, _), colour in zip(counted, SERIES, strict=False):
        panel.line(np.repeat(edges, 2)[1:-1], np.repeat(density, 2), colour)
    panel.line(x, normal, INK, 1.0, '5 3')
    panel.legend(
        *((f'{axis}: std {std:.2f}', colour, 'line')
          for axis, (_, std), colour in zip('uv', counted, SERIES, strict=False)),
        ('normal', INK, 'dash'),
    )  # fmt: skip
    return svg.chart([panel], _HEIGHT)


def whitened_residuals(residuals: Residuals) -> tuple[Floats, Floats]:
    """Whitened residuals of the used stars: unit variance if the covariances are correct."""
    used = residuals.used
    uu, uv, vv = whitening(residuals.covariance_px2[used])
    r_u, r_v = residuals.residual_px[used].T
    return uu * r_u + uv * r_v, vv * r_v


def before_and_after(
    residuals: Residuals, observations: Sequence[StarObservations], prior: CameraGeometry
) -> Markup:
    """Share of the stars within a distance of their prediction, by the prior and now; log axis."""
    before_px = np.concatenate(
        [
            np.hypot(*(image.measured_px - predicted_px(image, prior)).T)
            for image in observations
            if not image.refusal
        ]
        or [np.empty(0)]
    )
    after_px = np.hypot(*residuals.residual_px[residuals.used].T)
    before_px, after_px = np.sort(before_px[np.isfinite(before_px)]), np.sort(after_px)
    if not (len(before_px) and len(after_px)):
        return Markup()
    low = max(1e-4, float(np.quantile(after_px, 0.02)))
    high = max(2.0 * low, 1.2 * float(before_px[-1]), 1.2 * float(after_px[-1]))
    panel = Panel(
        Scale(low, high, _LEFT, _RIGHT, is_log=True), Scale(0.0, 100.0, _HEIGHT - _BELOW, _TOP)
    )
    panel.axes('distance from the prediction (px)', 'stars within it (%)')
    for values, colour in ((before_px, SERIES[1]), (after_px, SERIES[0])):
        at = np.linspace(0, len(values) - 1, min(len(values), 200)).astype(int)
        panel.line(np.maximum(values[at], low), 100.0 * (at + 1) / len(values), colour, 1.8)
    panel.legend(
        (f'prior: median {np.median(before_px):.3g} px', SERIES[1], 'line'),
        (f'calibrated: median {np.median(after_px):.3g} px', SERIES[0], 'line'),
        is_left=True,
    )
    return svg.chart([panel], _HEIGHT)


def spectrum(residuals: Residuals, camera: CameraModel) -> Markup:
    """Amplitude of waves in the residuals over the detector, with that of independent noise."""
    waves, amplitude_px, noise_px = wave_amplitudes(residuals, camera)
    top = 1.3 * max(float(amplitude_px.max()), noise_px)
    panel = _panel((0.5, _WAVES + 0.5), (0.0, top or 1.0))
    panel.axes('waves over the longer side of the detector', 'amplitude, rms (px)')
    panel.line(waves, amplitude_px, SERIES[0])
    panel.marks(waves, amplitude_px, SERIES[0])
    panel.line(np.array([0.5, _WAVES + 0.5]), np.full(2, noise_px), INK, 1.2, '5 3')
    panel.legend(('measured', SERIES[0], 'circle'), ('independent noise', INK, 'dash'))
    return svg.chart([panel], _HEIGHT)


def wave_amplitudes(residuals: Residuals, camera: CameraModel) -> tuple[Floats, Floats, float]:
    """
    Spectrum of the residuals: waves over the longer side, RMS amplitude (px), and that of noise.

    The mean over directions and both axes of ``|2/n sum r exp(-i k x)|^2``, x in cells of 1/64 of
    the longer side; for independent residuals of variance s^2 its expectation is 4 s^2 / n.
    """
    side, cells = float(max(camera.width, camera.height)), 64
    used = residuals.used
    place = np.floor((residuals.measured_px[used] + 0.5) / side * cells).astype(int)
    u, v = np.clip(place, 0, cells - 1).T
    count = max(int(used.sum()), 1)
    power = np.zeros((cells, cells))
    for component in residuals.residual_px[used].T:
        summed = np.bincount(v * cells + u, component, cells * cells).reshape(cells, cells)
        power += np.abs(np.fft.fft2(summed)) ** 2 / 2
    frequency = np.fft.fftfreq(cells, 1 / cells)
    length = np.hypot(frequency[:, None], frequency)
    ring = np.rint(length).astype(int).ravel()
    mean = np.bincount(ring, power.ravel()) / np.bincount(ring)
    waves = np.arange(1, _WAVES + 1)
    noise_px = 2.0 * float(np.sqrt((residuals.residual_px[used] ** 2).mean() / count))
    return waves.astype(float), 2.0 / count * np.sqrt(mean[waves]), noise_px


def residuals_against_magnitude(residuals: Residuals) -> Markup:
    """Residuals against V magnitude, with the RMS in bins and the expected sigma."""
    used = residuals.used & np.isfinite(residuals.magnitude)
    V, r = residuals.magnitude[used], residuals.residual_px[used]
    if not len(V):
        return Markup()
    # All per axis, so that points, measured RMS and expected sigma are comparable.
    length_px = np.sqrt((r**2).mean(axis=1))
    sigma_px = np.sqrt(residuals.covariance_px2[used][:, [0, 2]].mean(axis=1))
    edges = np.arange(np.floor(2 * V.min()) / 2, V.max() + 0.5, 0.5)
    panel = _panel(
        (float(edges[0]), float(max(edges[-1], edges[0] + 0.5))),
        (0.0, 1.15 * float(np.percentile(length_px, 99.5)) + 1e-6),
    )
    panel.cloud(V, length_px, 1.0, 0.35)
    panel.axes('magnitude V', 'residual, rms of u and v (px)')
    if len(edges) > 1:
        centre, measured_px = _in_bins(np.r_[V, V], r.T.ravel() ** 2, edges)[:2]
        panel.line(centre, np.sqrt(measured_px), SERIES[1])
        panel.marks(centre, np.sqrt(measured_px), SERIES[1])
        centre, expected_px = _in_bins(V, sigma_px**2, edges)[:2]
        panel.line(centre, np.sqrt(expected_px), INK, 1.4, '5 3')
    panel.legend(
        ('measured rms', SERIES[1], 'circle'), ('expected 1-sigma', INK, 'dash'), is_left=True
    )
    return svg.chart([panel], _HEIGHT)


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


def _means(x: Iterable[Floats], y: Iterable[Floats], edges: Floats, label: str,
           names: Sequence[str]) -> Markup:  # fmt: skip
    """Means of u and v with their standard errors in bins, about zero."""
    found = [_in_bins(a, b, edges) for a, b in zip(x, y, strict=True)]
    reach = [np.abs(mean) + error for _, mean, error in found]
    top = float(max([r.max() for r in reach if len(r)], default=0.0)) or 1.0
    panel = _panel((float(edges[0]), float(edges[-1])), (-1.1 * top, 1.45 * top))
    panel.axes(label, 'mean residual (px), 1-sigma bars')
    panel.line(np.array([edges[0], edges[-1]]), np.zeros(2), MUTED, 0.8)
    step = edges[1] - edges[0]
    for side, (centre, mean, error) in enumerate(found):
        at = centre + (side - 0.5) * 0.12 * step
        panel.bars(at, mean, error, SERIES[side])
        panel.marks(at, mean, SERIES[side], ('circle', 'square')[side])
    panel.legend(*zip(names, SERIES[:2], ('circle', 'square'), strict=True))
    return svg.chart([panel], _HEIGHT)


def residuals_against_colour(residuals: Residuals) -> Markup:
    """Mean residual against BP - RP, which shows lateral colour; '' if too few colours."""
    used = residuals.used & np.isfinite(residuals.colour_bp_rp)
    if np.count_nonzero(used) < 30:
        return Markup()
    colour = residuals.colour_bp_rp[used]
    low, high = np.percentile(colour, [1.0, 99.0]).tolist()
    if not high > low:
        return Markup()
    edges = np.linspace(low, high, 9, dtype=np.float64)
    residual_px = residuals.residual_px[used].T
    return _means([colour, colour], residual_px, edges, 'colour BP \N{MINUS SIGN} RP (mag)', 'uv')


def residuals_against_pixel_phase(residuals: Residuals) -> Markup:
    """Mean residual in u and v against the position of the centroid within its pixel."""
    place = residuals.measured_px[residuals.used].T
    edges = np.linspace(-0.5, 0.5, 11, dtype=np.float64)
    names = [f'{letter} against {letter}' for letter in 'uv']
    label = 'centroid position within its pixel (px)'
    residual_px = residuals.residual_px[residuals.used].T
    return _means(place - np.rint(place), residual_px, edges, label, names)


def alignment_in_time(residuals: Residuals, sigma_arcsec: Sequence[float]) -> Markup:
    """Star tracker error of each image from its stars, about the three tracker axes."""
    minutes = (residuals.image_time_ns - residuals.image_time_ns.min()) / (
        60.0 * NANOSECONDS_PER_SECOND
    )
    last, high = float(minutes.max()) or 1.0, 112.0
    misfit = residuals.image_misfit
    panels = []
    for k, axis in enumerate('xyz'):
        error, sigma = residuals.attitude_error_arcsec[:, k], residuals.attitude_sigma_arcsec[:, k]
        top = max(float(np.nanmax(np.abs(error[~misfit]), initial=0.0)), sigma_arcsec[k]) * 1.25
        upper = _TOP + k * (high + 14)
        panel = Panel(
            Scale(-0.03 * last, 1.03 * last, _LEFT, _RIGHT),
            Scale(-top or -1.0, top or 1.0, upper + high, upper),
        )
        label = 'time since the first image (min)' if axis == 'z' else ''
        panel.band(-sigma_arcsec[k], sigma_arcsec[k])
        panel.axes(label, f'{axis} (arcsec)', most=4)
        panel.bars(minutes, error, sigma, SERIES[0])
        panel.marks(minutes[~misfit], error[~misfit], SERIES[0])
        panel.marks(minutes[misfit], error[misfit], SERIES[1], 'cross', 4.0)
        panels.append(panel)
    return svg.chart(panels, _TOP + 3 * high + 28 + _BELOW)


def sigma_budget(parts: Sequence[SigmaPart]) -> Markup:
    """Share of the variance by cause as horizontal bars; the first part is the total."""
    total, causes = parts[0], parts[1:]
    bottom = max(_TOP + 24.0 + 34.0 * len(causes), _HEIGHT - _BELOW)
    panel = Panel(
        Scale(0.0, 100.0, _LEFT + 110.0, _RIGHT), Scale(len(causes) - 0.5, -0.9, bottom, _TOP)
    )
    panel.axes('share of the variance (%)', '')
    shares = (
        ('camera alone', SERIES[0], [part.map_arcsec / total.map_arcsec for part in causes]),
        (
            'with alignment',
            SERIES[1],
            [part.pointing_arcsec / total.pointing_arcsec for part in causes],
        ),
    )
    for k, part in enumerate(causes):
        y = float(panel.y(float(k))) + 4.0
        panel.parts.append(svg.words_at(_LEFT + 104.0, y, part.cause, 'end'))
        for (_, colour, values), shift in zip(shares, (-0.14, 0.14), strict=True):
            panel.line([0.0, 100.0 * values[k] ** 2], [k + shift, k + shift], colour, 8.0)
    panel.legend(*((name, colour, 'line') for name, colour, _ in shares))
    return svg.chart([panel], bottom + _BELOW)


def term_worth(removals: Sequence[TermRemoval]) -> Markup:
    """Residuals and map as terms are removed one after the other (paper, Fig. 8)."""
    steps = np.arange(len(removals), dtype=float)
    std_px = np.array([removal.residual_std_px for removal in removals])
    change_px = np.array([removal.map_change_px for removal in removals])
    change_px[0] = np.nan  # no term was removed: no change
    positive = np.concatenate([std_px.ravel(), change_px])
    positive = positive[np.isfinite(positive) & (positive > 0)]
    low, high = (positive.min() / 1.5, positive.max() * 4) if len(positive) else (0.1, 1.0)
    panel = Panel(
        Scale(-0.5, len(removals) - 0.5, _LEFT, _RIGHT),
        Scale(float(low), float(high), _HEIGHT - _BELOW - 20, _TOP, is_log=True),
    )
    negligible = [k for k, removal in enumerate(removals) if removal.negligible]
    if len(negligible) > 1:
        panel.band(-0.5, max(negligible) + 0.5, is_vertical=True)
    panel.axes('', 'px')
    for k, removal in enumerate(removals):
        name = f'\N{MINUS SIGN}{removal.removed}' if k else 'none'
        x, y = float(panel.x(float(k))), panel.y.start + 14
        panel.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="end" fill="{INK}"'
            f' transform="rotate(-45 {x:.1f} {y:.1f})">{Markup.escape(name)}</text>'
        )
    panel.parts.append(svg.words_at((_LEFT + _RIGHT) / 2, _HEIGHT - 5, 'removed, one by one'))
    curves = (
        (std_px[:, 0], 'residual, std of u', SERIES[0], 'circle'),
        (std_px[:, 1], 'residual, std of v', SERIES[1], 'square'),
        (change_px, 'change of the map, rms', SERIES[2], 'triangle'),
    )
    for values, _, colour, shape in curves:
        panel.line(steps, np.where(values > 0, values, np.nan), colour)
        panel.marks(steps, np.where(values > 0, values, np.nan), colour, shape)
    panel.legend(*((label, colour, shape) for _, label, colour, shape in curves), is_left=True)
    return svg.chart([panel], _HEIGHT)
