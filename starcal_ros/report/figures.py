"""
Figures of the report as inline SVG, and the figure of a comparison as a file.

Colours that depend on the theme of the page are drawn with placeholder colours that become CSS
variables, so one drawing serves light, dark and print; text stays text in the font of the page.
"""

from __future__ import annotations

from collections.abc import Sequence
import html
import io
from pathlib import Path
import re

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np
from scipy.stats import binned_statistic, norm

from starcal_ros.arrays import Floats
from starcal_ros.assessment import comparison
from starcal_ros.assessment.agreement import movement
from starcal_ros.assessment.comparison import Comparison, DifferenceMap
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.camera import CameraModel, distortion_px, pixel_grid
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.estimation.normal_equations import whitening
from starcal_ros.records import CameraGeometry, DetectorMaps, TermRemoval
from starcal_ros.report.term_removal_figure import curves_of, plot_curves

COMPARISON_FORMATS = ('.png', '.svg', '.pdf')

# Placeholder colours, used by nothing else -> CSS variables of report.css.
INK, MUTED, GRID, PAPER = '#010203', '#010204', '#010205', '#010206'
SERIES = ('#010207', '#010208', '#010209')
_VARIABLES = {INK: '--ink', MUTED: '--muted', GRID: '--grid', PAPER: '--paper'} | {
    colour: f'--series-{k + 1}' for k, colour in enumerate(SERIES)
}
# For rasterised clouds of points: readable on white and on black.
_POINTS = '#3d8bd4'
STYLE = {
    'svg.fonttype': 'none',
    'svg.hashsalt': 'starcal',
    'font.size': 9.5,
    'axes.edgecolor': MUTED,
    'axes.labelcolor': INK,
    'axes.titlesize': 9.5,
    'axes.linewidth': 0.8,
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.facecolor': 'none',
    'figure.facecolor': 'none',
    'savefig.facecolor': 'none',
    'grid.color': GRID,
    'grid.linewidth': 0.7,
    'text.color': INK,
    'xtick.color': MUTED,
    'ytick.color': MUTED,
    'xtick.labelcolor': INK,
    'ytick.labelcolor': INK,
    'legend.frameon': False,
    'legend.fontsize': 9,
    'patch.linewidth': 0.0,
}
_SIZE = (4.7, 3.5)
_TITLED = 'titled'  # group id of the points that get titles, which a browser shows on hover


def _figure(width: float = _SIZE[0], height: float = _SIZE[1]) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout='constrained')
    return figure, figure.subplots()


def _svg(figure: Figure, name: str, titles: Sequence[str] = ()) -> Markup:
    """
    SVG element of a figure; the name makes its identifiers unique.

    ``titles`` belong to the points drawn under the group id `_TITLED`, in order.
    """
    memory = io.StringIO()
    figure.savefig(memory, format='svg', dpi=144, metadata={'Date': None, 'Creator': None})
    text = memory.getvalue()
    text = text[text.index('<svg') :]
    # The page sets the size, viewBox the aspect ratio.
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r'\1', text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r'\1', text, count=1)
    text = text.replace('<svg', '<svg aria-hidden="true"', 1)
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.DOTALL)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f'var({variable})')
    text = re.sub(r'font: ([\d.]+px) [^;\"]*', r'font: \1 var(--font)', text)
    if titles:
        text = _with_titles(text, titles)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(xlink:href="#|url\(#)', rf'\g<1>{name}-', text)
    return Markup(text)


inline_svg = _svg  # for pages of other rooms


def _with_titles(text: str, titles: Sequence[str]) -> str:
    """Add titles to the points of the group, which a browser shows on hover."""
    first = text.index(f'id="{_TITLED}"')
    last = first + text[first:].index('</g>\n   </g>') if '</g>\n   </g>' in text[first:] else None
    group = text[first:last]
    count = iter(titles)
    titled = re.sub(
        r'<use ([^>]*?)/>',
        lambda use: f'<use {use[1]}><title>{html.escape(next(count))}</title></use>',
        group,
        count=len(titles),
    )
    return text[:first] + titled + ('' if last is None else text[last:])


def _rms_in_bins(x: Floats, values: Floats, edges: Floats) -> tuple[Floats, Floats]:
    """Centres of the bins with at least ten values, and the RMS of their values."""
    square, _, which = binned_statistic(x, values**2, 'mean', edges)
    enough = np.bincount(which, minlength=len(edges) + 1)[1:-1] >= 10
    return (0.5 * (edges[1:] + edges[:-1]))[enough], np.sqrt(square[enough])


def _detector_figure(camera: CameraModel, beside: float = 0.0) -> tuple[Figure, Axes]:
    """Figure with the aspect ratio of the detector; ``beside`` is reserved at the right, inch."""
    height = 0.75 + (3.9 - beside) * camera.height / camera.width
    figure, axes = _figure(_SIZE[0], min(height, 5.5))
    axes.set(
        xlim=(-0.5, camera.width - 0.5),
        ylim=(camera.height - 0.5, -0.5),
        aspect='equal',
        xlabel='column u (px)',
        ylabel='row v (px)',
    )
    axes.grid(False)
    axes.spines[['top', 'right']].set_visible(True)
    return figure, axes


def star_coverage(residuals: Residuals, camera: CameraModel) -> Markup:
    """Positions of all used stars on the detector (paper, Fig. 5)."""
    figure, axes = _detector_figure(camera)
    u, v = residuals.measured_px[residuals.used].T
    size = np.clip(4000.0 / max(len(u), 1), 0.6, 5.0)
    axes.scatter(u, v, s=size, color=_POINTS, linewidths=0, rasterized=True)
    return _svg(figure, 'coverage')


def cell_counts(maps: DetectorMaps, camera: CameraModel) -> Markup:
    """Star counts in equal cells of the detector."""
    figure, axes = _detector_figure(camera)
    counts = maps.stars
    rows, columns = counts.shape
    share = counts / max(int(counts.max()), 1)
    u = (np.arange(columns) + 0.5) * camera.width / columns - 0.5
    v = (np.arange(rows) + 0.5) * camera.height / rows - 0.5
    extent = (-0.5, camera.width - 0.5, camera.height - 0.5, -0.5)
    axes.imshow(share, extent=extent, cmap='Blues', vmin=-0.15, vmax=1.1, aspect='equal')
    size = min(9.0, 90.0 / columns)
    for (row, column), count in np.ndenumerate(counts):
        dark, empty = share[row, column] > 0.55, count == 0
        colour = '#b3261e' if empty else '#ffffff' if dark else '#12324f'
        axes.text(u[column], v[row], str(count), ha='center', va='center', color=colour,
                  fontsize=size)  # fmt: skip
    return _svg(figure, 'cells')


def _contours(axes: Axes, camera: CameraModel, length: Floats, unit: str) -> None:
    """Labelled contours of a grid (48, 60) of values over the detector."""
    u, v = (a.reshape(48, 60) for a in pixel_grid(camera, 60, 48).T)
    # Few enough levels for a label on each.
    lines = axes.contour(u, v, length, levels=7, cmap='viridis', linewidths=1.4)
    axes.clabel(lines, fmt=lambda level: f'{level:g}{unit}', fontsize=9, colors=[INK])


def distortion_vectors(camera: CameraModel) -> Markup:
    """Distortion as arrows (paper, Fig. 6 left)."""
    return _arrows(camera, pixel_grid(camera, 17, 13), None, 'vectors')


def distortion_contours(camera: CameraModel) -> Markup:
    """Length of the distortion in pixels (paper, Fig. 6 right)."""
    figure, axes = _detector_figure(camera)
    shift = distortion_px(camera, pixel_grid(camera, 60, 48))
    _contours(axes, camera, np.hypot(*shift.T).reshape(48, 60), ' px')
    return _svg(figure, 'contours')


def change_contours(before: CameraGeometry, after: CameraGeometry) -> Markup:
    """Change of the lines of sight in pixels, common rotation removed."""
    figure, axes = _detector_figure(after.camera)
    _, moved_px = movement(before, after, 60, 48)
    _contours(axes, after.camera, moved_px.reshape(48, 60), ' px')
    return _svg(figure, 'change')


def _arrows(camera: CameraModel, places: Floats, arrows: Floats | None, name: str) -> Markup:
    shift = distortion_px(camera, places) if arrows is None else arrows
    figure, axes = _detector_figure(camera)
    longest = float(np.nanmax(np.hypot(*shift.T), initial=0.0))
    key = _round_length(longest)
    # The longest arrow spans one step of a grid of seventeen columns.
    scale = (longest or 1.0) / (0.9 * camera.width / 16)
    quiver = axes.quiver(
        *places.T, *shift.T, angles='xy', scale_units='xy', scale=scale, color=SERIES[0],
        width=0.0035, headwidth=4,
    )  # fmt: skip
    axes.plot(*places.T, '.', color=MUTED, markersize=1.2)
    axes.set_title(' ')  # reserves room: an arrow above the canvas would not be drawn
    # The key's text would otherwise take the colour of the arrows.
    axes.quiverkey(
        quiver, 0.9, 1.05, key, f'{key:g} px', labelpos='W', color=SERIES[1], labelcolor=INK,
        coordinates='axes',
    )  # fmt: skip
    return _svg(figure, name)


def _round_length(longest: float) -> float:
    """Largest 1, 2 or 5 times a power of ten that does not exceed a length."""
    if not longest > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(longest))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= longest))


def residual_field(residuals: Residuals, camera: CameraModel) -> Markup:
    """Mean residual in cells of the detector, which shows unmodelled distortion."""
    u, v = residuals.measured_px[residuals.used].T
    edges_u = np.linspace(-0.5, camera.width - 0.5, 13)
    edges_v = np.linspace(-0.5, camera.height - 0.5, 11)
    mean = [
        np.histogram2d(u, v, (edges_u, edges_v), weights=component)[0]
        for component in residuals.residual_px[residuals.used].T
    ]
    count = np.histogram2d(u, v, (edges_u, edges_v))[0]
    enough = count >= 5
    centre_u, centre_v = (0.5 * (e[1:] + e[:-1]) for e in (edges_u, edges_v))
    places = np.stack(np.meshgrid(centre_u, centre_v, indexing='ij'), axis=-1)[enough]
    arrows = np.stack([m[enough] / count[enough] for m in mean], axis=-1)
    return _arrows(camera, places, arrows, 'field')


def residuals_of_images(residuals: Residuals) -> Markup:
    """RMS residual of the used stars of each image, in time order."""
    figure, axes = _figure()
    rms = residuals.image_rms_px()
    number = np.arange(1, len(rms) + 1)
    stars = np.bincount(residuals.image[residuals.used], minlength=len(rms))
    points = axes.scatter(number, rms, s=26, color=SERIES[0], linewidths=0)
    points.set_gid(_TITLED)
    top = 1.15 * float(np.nanmax(rms, initial=0.0)) or 1.0
    axes.set(xlabel='image', ylabel='residual, rms per axis (px)', ylim=(0, top))
    axes.margins(x=0.04)
    _whole_numbers(axes, len(rms))
    shown = np.isfinite(rms)
    titles = [
        f'image {n}: {r:.4f} px rms, {s} stars'
        for n, r, s in zip(number[shown], rms[shown], stars[shown], strict=True)
    ]
    return _svg(figure, 'images', titles)


def _whole_numbers(axes: Axes, count: int) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0.5 - 0.02 * count, count + 0.5 + 0.02 * count)


def histogram(residuals: Residuals) -> Markup:
    """Normalised residuals and the normal distribution (paper, Fig. 7)."""
    figure, axes = _figure()
    edges = np.linspace(-5, 5, 51)
    whitened = whitened_residuals(residuals)
    for values, colour, name in zip(whitened, SERIES, 'uv', strict=False):
        axes.hist(
            np.clip(values, -4.999, 4.999), edges.tolist(), density=True, histtype='step',
            color=colour, linewidth=1.5, label=f'{name}: std {values.std():.2f}',
        )  # fmt: skip
    x = np.linspace(-5, 5, 201)
    axes.plot(x, norm.pdf(x), color=INK, linewidth=1.0, linestyle='--', label='normal')
    axes.set(xlabel='normalised residual (sigma)', ylabel='density', xlim=(-5, 5))
    axes.legend(loc='upper right', handlelength=1.4)
    return _svg(figure, 'histogram')


def whitened_residuals(residuals: Residuals) -> tuple[Floats, Floats]:
    """Whitened residuals of the used stars: unit variance if the covariances are correct."""
    used = residuals.used
    uu, uv, vv = whitening(residuals.covariance_px2[used])
    r_u, r_v = residuals.residual_px[used].T
    return uu * r_u + uv * r_v, vv * r_v


def residuals_against_magnitude(residuals: Residuals) -> Markup:
    """Residuals against V magnitude, with the RMS in bins and the expected sigma."""
    used = residuals.used & np.isfinite(residuals.magnitude)
    V, r = residuals.magnitude[used], residuals.residual_px[used]
    figure, axes = _figure()
    sigma = np.sqrt(residuals.covariance_px2[used][:, [0, 2]].mean(axis=1))
    # All per axis, so that points, measured RMS and expected sigma are comparable.
    axes.scatter(V, np.sqrt((r**2).mean(axis=1)), s=3, color=_POINTS, alpha=0.35, linewidths=0,
                 rasterized=True)  # fmt: skip
    if len(V):
        edges = np.arange(np.floor(2 * V.min()) / 2, V.max() + 0.5, 0.5)
        if len(edges) > 1:
            axes.plot(*_rms_in_bins(np.r_[V, V], r.T.ravel(), edges), 'o-', color=SERIES[1],
                      markersize=4, linewidth=1.3, label='measured rms')  # fmt: skip
            axes.plot(*_rms_in_bins(V, sigma, edges), '--', color=INK, linewidth=1.2,
                      label='expected 1-sigma')  # fmt: skip
        axes.set_ylim(0, 1.15 * float(np.percentile(np.sqrt((r**2).mean(axis=1)), 99.5)) + 1e-6)
        axes.legend(loc='upper left', handlelength=1.6)
    axes.set(xlabel='magnitude V', ylabel='residual, rms of u and v (px)')
    return _svg(figure, 'magnitude')


def _means(axes: Axes, x: Floats, y: Floats, edges: Floats, side: int, label: str) -> None:
    """Plot means and their standard errors in bins with at least ten values."""
    mean, _, which = binned_statistic(x, y, 'mean', edges)
    std, _, _ = binned_statistic(x, y, 'std', edges)
    count = np.bincount(which, minlength=len(edges) + 1)[1:-1]
    enough = count >= 10
    centre = 0.5 * (edges[1:] + edges[:-1])[enough] + (side - 0.5) * 0.12 * (edges[1] - edges[0])
    axes.errorbar(
        centre, mean[enough], std[enough] / np.sqrt(count[enough]), fmt='os'[side],
        color=SERIES[side], markersize=4, linewidth=1.2, capsize=2, label=label,
    )  # fmt: skip


def _about_zero(axes: Axes) -> None:
    axes.axhline(0, color=MUTED, linewidth=0.8)
    top = max(abs(limit) for limit in axes.get_ylim())
    axes.set_ylim(-top, 1.25 * top)
    axes.set_ylabel('mean residual (px), 1-sigma bars')
    axes.legend(loc='upper right', ncols=2, handlelength=1.2)


def residuals_against_colour(residuals: Residuals) -> Markup:
    """Mean residual against BP - RP, which shows lateral colour; '' if too few colours."""
    used = residuals.used & np.isfinite(residuals.colour_bp_rp)
    if np.count_nonzero(used) < 30:
        return Markup()
    colour = residuals.colour_bp_rp[used]
    low, high = np.percentile(colour, [1.0, 99.0]).tolist()
    edges = np.linspace(low, high, 9, dtype=np.float64)
    if not edges[-1] > edges[0]:
        return Markup()
    figure, axes = _figure()
    for side, letter in enumerate('uv'):
        _means(axes, colour, residuals.residual_px[used, side], edges, side, letter)
    axes.set_xlabel('colour BP \N{MINUS SIGN} RP (mag)')
    _about_zero(axes)
    return _svg(figure, 'colour')


def residuals_against_pixel_phase(residuals: Residuals) -> Markup:
    """Mean residual in u and v against the position of the centroid within its pixel."""
    figure, axes = _figure()
    for side, letter in enumerate('uv'):
        place = residuals.measured_px[residuals.used, side]
        residual = residuals.residual_px[residuals.used, side]
        edges = np.linspace(-0.5, 0.5, 11, dtype=np.float64)
        _means(axes, place - np.rint(place), residual, edges, side, f'{letter} against {letter}')
    axes.set_xlabel('centroid position within its pixel (px)')
    _about_zero(axes)
    return _svg(figure, 'phase')


def line_of_sight_sigma(sigma_arcsec: Floats, camera: CameraModel, name: str) -> Markup:
    """1-sigma of the lines of sight on a grid of pixels from corner to corner, arcsec."""
    figure, axes = _detector_figure(camera, beside=0.8)
    rows, columns = sigma_arcsec.shape
    u = np.linspace(0, camera.width - 1, columns)
    v = np.linspace(0, camera.height - 1, rows)
    # Bands of equal area: with equal steps the corners would use up the colours.
    levels = np.unique(np.quantile(sigma_arcsec, np.linspace(0, 1, 9)))
    if len(levels) > 1:
        filled = axes.contourf(
            u, v, sigma_arcsec, levels, cmap='viridis', norm=BoundaryNorm(levels, 256)
        )
        bar = figure.colorbar(filled, cax=axes.inset_axes((1.03, 0, 0.045, 1)), spacing='uniform')
        bar.set_ticks(levels.tolist(), labels=_distinct_labels(levels))
        bar.ax.tick_params(size=0)
        bar.set_label('1-sigma (arcsec)')
    return _svg(figure, name)


def _distinct_labels(levels: Floats) -> list[str]:
    """Numbers with three significant digits, or more until all labels differ."""
    for digits in range(3, 7):
        labels = [f'{level:.{digits}g}' for level in levels]
        if len(set(labels)) == len(labels):
            break
    return labels


def alignment_in_time(residuals: Residuals, sigma_arcsec: Sequence[float]) -> Markup:
    """Star tracker error of each image from its stars, about the three tracker axes."""
    figure = Figure(figsize=(_SIZE[0], 4.6), layout='constrained')
    panels = figure.subplots(3, 1, sharex=True)
    minutes = (residuals.image_time_ns - residuals.image_time_ns.min()) / (
        60.0 * NANOSECONDS_PER_SECOND
    )
    for k, (axes, axis) in enumerate(zip(panels, 'xyz', strict=True)):
        axes.axhspan(-sigma_arcsec[k], sigma_arcsec[k], color=GRID, alpha=0.6, linewidth=0)
        axes.axhline(0, color=MUTED, linewidth=0.8)
        for chosen, colour, marker in (
            (~residuals.image_misfit, SERIES[0], 'o'),
            (residuals.image_misfit, SERIES[1], 'x'),
        ):
            axes.errorbar(
                minutes[chosen], residuals.attitude_error_arcsec[chosen, k],
                residuals.attitude_sigma_arcsec[chosen, k], fmt=marker, color=colour,
                markersize=4.5, linewidth=1.1, capsize=2,
            )  # fmt: skip
        axes.set_ylabel(f'{axis} (arcsec)')
        good = residuals.attitude_error_arcsec[~residuals.image_misfit, k]
        top = max(np.nanmax(np.abs(good), initial=0.0), sigma_arcsec[k]) * 1.25
        axes.set_ylim(-top, top)
    panels[-1].set_xlabel('time since the first image (min)')
    return _svg(figure, 'alignment')


def term_worth(removals: Sequence[TermRemoval]) -> Markup:
    """Residuals and map as terms are removed one after the other (paper, Fig. 8)."""
    figure, axes = _figure()
    steps = np.arange(len(removals))
    negligible = [k for k, removal in enumerate(removals) if removal.negligible]
    if len(negligible) > 1:
        axes.axvspan(-0.5, max(negligible) + 0.5, color=GRID, alpha=0.6, linewidth=0)
    plot_curves(axes, *curves_of(removals))
    axes.set_xlim(-0.5, len(removals) - 0.5)
    axes.set_xticks(
        steps,
        ['none', *(f'\N{MINUS SIGN}{removal.removed}' for removal in removals[1:])],
        rotation=45,  # ten names do not fit beside each other
    )
    axes.set_xlabel('removed, one after the other')
    return _svg(figure, 'terms')


def write_comparison(found: Comparison, path: Path) -> None:
    """
    Draw the difference of two calibrations over the detector, with and without common rotation.

    Arrows are in pixels, colours in sigmas (in pixels if nothing was estimated).

    Raises
    ------
    OptionError
        For an ending that is none of `COMPARISON_FORMATS`.
    ProductError
        When the file cannot be written.
    """
    if path.suffix not in COMPARISON_FORMATS:
        raise OptionError(f'{path}: the name must end in {", ".join(COMPARISON_FORMATS)}')
    figure = Figure(figsize=(11.0, 4.6), layout='constrained')
    left, right = figure.subplots(1, 2)
    camera = found.a.geometry.camera
    _difference(left, camera, found.before, 'lines of sight, B minus A')
    _difference(right, camera, found.after, 'common rotation removed')
    memory = io.BytesIO()
    figure.savefig(memory, format=path.suffix[1:], dpi=130)
    try:
        path.write_bytes(memory.getvalue())
    except OSError as error:
        raise ProductError(f'{path}: cannot be written: {error.strerror}') from error


def _difference(axes: Axes, camera: CameraModel, found: DifferenceMap, title: str) -> None:
    n = comparison.GRID
    grid_px = pixel_grid(camera, n, n).reshape(n, n, 2)
    in_sigmas = not np.isnan(found.sigmas).all()
    levels = np.nan_to_num(found.sigmas) if in_sigmas else found.length_px
    filled = axes.contourf(*np.moveaxis(grid_px, -1, 0), levels, 12, cmap='viridis')
    axes.figure.colorbar(
        filled, ax=axes, shrink=0.8, label=f'length ({"sigma" if in_sigmas else "px"})'
    )
    worst_px, every_other = float(found.length_px.max()), slice(None, None, 2)
    if worst_px > 0:  # arrows of zero length have no scale
        axes.quiver(
            *np.moveaxis(grid_px[every_other, every_other], -1, 0),
            *np.moveaxis(found.difference_px[every_other, every_other], -1, 0),
            angles='xy', color='white', edgecolor='black', linewidth=0.4, width=0.004,
        )  # fmt: skip
    axes.set_title(f'{title}: at most {worst_px:.3g} px', fontsize=10)
    axes.set(xlabel='u (px)', ylabel='v (px)', aspect='equal')
    axes.set(xlim=(0, camera.width - 1), ylim=(camera.height - 1, 0))
