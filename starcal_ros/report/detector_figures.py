# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of the report over the detector and over the sky, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
import functools
from typing import Any

import contourpy
import cv2
from markupsafe import Markup
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.assessment.agreement import movement
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.camera import CameraModel, distortion_px, line_of_sight, pixel_grid
from starcal_ros.detector_field import DetectorField
from starcal_ros.records import CameraGeometry, DetectorMaps, StarObservations
from starcal_ros.report import svg
from starcal_ros.report.svg import BAD, GRID, in_digits, INK, MUTED, Panel, Scale, SERIES

FLAT = 0.02  # relative range below which a map is called flat
_MOST_HEIGHT = 400.0
_ROUNDING_PX = 1e-9  # displacements below are of the arithmetic
_LEVELS = 8
_LABELS_APART = 30.0  # units of the view box
_FOOTPRINTS = 200  # drawn on the sky


def _detector(camera: CameraModel, right: float = 12.0, top: float = 26.0) -> tuple[Panel, float]:
    """Panel with the aspect ratio of the detector and the height of its chart."""
    left, below = 54.0, 40.0
    wide = svg.WIDTH - left - right
    high = wide * camera.height / camera.width
    if high > _MOST_HEIGHT:
        wide, high = wide * _MOST_HEIGHT / high, _MOST_HEIGHT
    panel = Panel(
        Scale(-0.5, camera.width - 0.5, left, left + wide),
        Scale(-0.5, camera.height - 0.5, top, top + high),
    )
    return panel, top + high + below


def _framed(panel: Panel) -> None:
    panel.axes('column u (px)', 'row v (px)', is_framed=True)


def star_coverage(residuals: Residuals, camera: CameraModel) -> Markup:
    """Positions of all used stars on the detector (paper, Fig. 5)."""
    panel, height = _detector(camera)
    u, v = residuals.measured_px[residuals.used].T
    radius = float(np.clip(40.0 / np.sqrt(max(len(u), 1)), 0.5, 1.6))
    panel.cloud(u, v, radius, 0.8)
    _framed(panel)
    return svg.chart([panel], height)


def cell_counts(maps: DetectorMaps, camera: CameraModel) -> Markup:
    """Star counts in equal cells of the detector; empty cells have a red edge."""
    panel, height = _detector(camera)
    rows, columns = maps.stars.shape
    edges_u = panel.x(np.linspace(-0.5, camera.width - 0.5, columns + 1))
    edges_v = panel.y(np.linspace(-0.5, camera.height - 0.5, rows + 1))
    share = maps.stars / max(int(maps.stars.max()), 1)
    size = min(svg.LETTER, 124.0 / columns)
    for (row, column), count in np.ndenumerate(maps.stars):
        x, y = edges_u[column], edges_v[row]
        wide, high = edges_u[column + 1] - x, edges_v[row + 1] - y
        edge = BAD if count == 0 else svg.PAPER
        panel.parts.append(
            f'<rect x="{x + 0.7:.1f}" y="{y + 0.7:.1f}" width="{wide - 1.4:.1f}"'
            f' height="{high - 1.4:.1f}" fill="{SERIES[0]}"'
            f' fill-opacity="{0.06 + 0.5 * share[row, column]:.2f}" stroke="{edge}"/>'
        )
        colour = BAD if count == 0 else INK
        panel.parts.append(
            f'<text x="{x + wide / 2:.1f}" y="{y + high / 2 + 0.35 * size:.1f}"'
            f' text-anchor="middle" font-size="{size:.1f}" fill="{colour}">{count}</text>'
        )
    _framed(panel)
    return svg.chart([panel], height)


def distortion_vectors(camera: CameraModel) -> Markup:
    """Distortion as arrows (paper, Fig. 6 left)."""
    places = pixel_grid(camera, 17, 13)
    return _arrows(camera, places, distortion_px(camera, places))


def distortion_contours(camera: CameraModel) -> Markup:
    """Length of the distortion in pixels (paper, Fig. 6 right)."""
    shift = distortion_px(camera, pixel_grid(camera, 60, 48))
    return _contours(camera, np.hypot(*shift.T))


def change_contours(before: CameraGeometry, after: CameraGeometry) -> Markup:
    """Change of the lines of sight in pixels, common rotation removed."""
    _, moved_px = movement(before, after, 60, 48)
    return _contours(after.camera, moved_px)


def mean_residuals(residuals: Residuals, camera: CameraModel) -> Markup:
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
    return _arrows(camera, places, np.stack([m[enough] / count[enough] for m in mean], axis=-1))


def field_vectors(field: DetectorField, camera: CameraModel) -> Markup:
    """The residual field beside the lens model as arrows."""
    places = pixel_grid(camera, 17, 13)
    return _arrows(camera, places, field.displacement_px(places))


def _arrows(camera: CameraModel, places: Floats, shift_px: Floats) -> Markup:
    """Enlarged displacements (n, 2) at places (n, 2), with an arrow of a round length as scale."""
    panel, height = _detector(camera)
    _framed(panel)
    longest_px = float(np.nanmax(np.hypot(*shift_px.T), initial=0.0))
    if not longest_px > _ROUNDING_PX:
        panel.note('no displacement')
        return svg.chart([panel], height)
    wide = abs(panel.x.end - panel.x.start)
    # The longest arrow spans one step of a grid of seventeen columns.
    units_per_px = 0.95 * wide / 16 / longest_px
    panel.arrows(places, units_per_px * shift_px, SERIES[0])
    key_px = 10.0 ** np.floor(np.log10(longest_px))
    key_px = max(k * key_px for k in (1.0, 2.0, 5.0) if k * key_px <= longest_px)
    end = panel.x.end
    along = np.array([units_per_px * key_px, 0.0])
    panel.parts.append(svg.arrow(np.array([end - along[0], 13.0]), along, SERIES[1]))
    label = f'scale: {in_digits(key_px)} px'
    panel.parts.append(svg.words_at(end - along[0] - 7, 17, label, 'end'))
    return svg.chart([panel], height)


def _contours(camera: CameraModel, length_px: Floats) -> Markup:
    """Labelled contours of a grid (48 * 60) of lengths in pixels."""
    panel, height = _detector(camera)
    u, v = (a.reshape(48, 60) for a in pixel_grid(camera, 60, 48).T)
    length = length_px.reshape(48, 60)
    low, high = float(np.nanmin(length)), float(np.nanmax(length))
    if not high - low > _ROUNDING_PX:
        panel.note(f'{in_digits(round(high, 9))} px everywhere')
        _framed(panel)
        return svg.chart([panel], height)
    levels = [level for level in Scale(low, high, 0, 1).ticks(_LEVELS) if low < level < high]
    _draw_contours(panel, u, v, length, levels, ' px')
    _framed(panel)
    return svg.chart([panel], height)


def _draw_contours(
    panel: Panel,
    u: Floats,
    v: Floats,
    values: Floats,
    levels: Sequence[float],
    unit: str,
    colour: str = SERIES[0],
) -> None:
    """Contours, thicker for higher levels, each with one label if there is room for it."""
    generator = contourpy.contour_generator(u, v, values)
    labels: list[tuple[Floats, str]] = []
    middle = np.array([panel.x.end + panel.x.start, panel.y.end + panel.y.start]) / 2
    for k, level in enumerate(levels):
        width = 1.0 + 1.4 * k / max(len(levels) - 1, 1)
        drawn = []
        for line in _lines_at(generator, level):
            panel.line(line[:, 0], line[:, 1], colour, width)
            drawn.append(np.stack([panel.x(line[:, 0]), panel.y(line[:, 1])], axis=-1))
        places = np.concatenate(drawn or [np.empty((0, 2))])
        inner = abs(places - middle) < 0.46 * np.abs(
            [panel.x.end - panel.x.start, panel.y.end - panel.y.start]
        )
        places = places[inner.all(axis=1)]
        if len(places):
            others = np.array([place for place, _ in labels] or [np.full(2, -1e4)])
            apart = np.linalg.norm(places[:, None] - others, axis=-1).min(axis=1)
            if apart.max() > _LABELS_APART:
                labels.append((places[int(np.argmax(apart))], f'{in_digits(level)}{unit}'))
    for (x, y), words in labels:
        panel.parts.append(
            f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle" fill="{INK}"'
            f' stroke="{svg.PAPER}" stroke-width="3" paint-order="stroke">{words}</text>'
        )


def _lines_at(generator: contourpy.ContourGenerator, level: float) -> list[Floats]:
    """Lines (n, 2) of a level; contourpy's types allow other forms as well."""
    return [np.asarray(line, np.float64) for line in generator.lines(level)]


def line_of_sight_sigma(sigma_arcsec: Floats, camera: CameraModel) -> Markup:
    """1-sigma of the lines of sight from corner to corner, on a scale that starts at zero."""
    panel, height = _detector(camera, right=74.0)
    top_arcsec = float(sigma_arcsec.max())
    if not (np.isfinite(top_arcsec) and top_arcsec > 0):
        panel.note('unknown')
        _framed(panel)
        return svg.chart([panel], height)
    panel.picture(_coloured(cv2.resize(255 * sigma_arcsec / top_arcsec, (240, 192))))
    rows, columns = sigma_arcsec.shape
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    )
    low = float(sigma_arcsec.min())
    if top_arcsec - low > FLAT * top_arcsec:
        levels = [x for x in Scale(low, top_arcsec, 0, 1).ticks(4) if low < x < top_arcsec]
        _draw_contours(panel, u, v, sigma_arcsec, levels, '″', svg.PAPER)
    else:
        percent = 100 * (top_arcsec - low) / top_arcsec
        panel.note(f'flat within {in_digits(round(percent, 2))} %')
    _framed(panel)
    bar = Panel(Scale(0, 1, panel.x.end + 12, panel.x.end + 26), _upright(panel, top_arcsec))
    bar.picture(_coloured(np.linspace(255, 0, 128)[:, None]))
    for value in bar.y.ticks(5):
        y = float(bar.y(value))
        bar.parts.append(svg.words_at(bar.x.end + 5, y + 4, f'{in_digits(value)}″', 'start'))
    return svg.chart([panel, bar], height)


def _upright(panel: Panel, top: float) -> Scale:
    return Scale(0.0, top, panel.y.end, panel.y.start)


def _coloured(levels: NDArray[Any]) -> NDArray[np.uint8]:
    """BGR picture of levels 0 to 255."""
    return np.asarray(_viridis()[np.rint(np.clip(levels, 0, 255)).astype(np.uint8)])


@functools.cache
def _viridis() -> NDArray[np.uint8]:
    """Colours (256, 3) BGR; OpenCV makes its own table anew, in 10 ms, for each picture."""
    shades = np.arange(256, dtype=np.uint8)[:, None]  # OpenCV 5 returns another shape for (256,)
    return np.asarray(cv2.applyColorMap(shades, cv2.COLORMAP_VIRIDIS)[:, 0], np.uint8)


def pointings(
    observations: Sequence[StarObservations], geometry: CameraGeometry
) -> tuple[Markup, int]:
    """
    Footprints of the images on the whole sky, and their number.

    A Hammer projection of the ICRS, right ascension 0 in the middle and increasing to the left.
    Refused images that have an attitude are drawn too.
    """
    placed = [o for o in observations if not o.refusal or np.isfinite(o.attitude_gap_s)]
    left, right, top, high = 8.0, svg.WIDTH - 8.0, 8.0, (svg.WIDTH - 16.0) / 2
    panel = Panel(
        Scale(-2 * np.sqrt(2), 2 * np.sqrt(2), left, right),
        Scale(-np.sqrt(2), np.sqrt(2), top + high, top),
    )
    _draw_graticule(panel)
    camera = geometry.camera
    edge = np.linspace(-0.5, 0.5, 9)
    border = np.concatenate(
        [np.c_[edge, edge * 0 - 0.5], np.c_[edge * 0 + 0.5, edge],
         np.c_[edge[::-1], edge * 0 + 0.5], np.c_[edge * 0 - 0.5, edge[::-1]]]
    )  # fmt: skip
    size = np.array([camera.width, camera.height])
    in_camera = line_of_sight(camera, (border + 0.5) * size - 0.5)
    in_tracker = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).apply(in_camera)
    every = -(-len(placed) // _FOOTPRINTS) or 1
    for one in placed[::every]:
        on_sky = Rotation.from_quat(one.icrf_from_star_tracker_xyzw).apply(in_tracker)
        x, y = hammer(on_sky)
        # Across the edge of the map a line would run through all of it.
        x = np.where(np.abs(np.diff(x, prepend=x[:1])) > 2.0, np.nan, x)
        panel.line(x, y, SERIES[1] if one.refusal else SERIES[0], 1.2)
    below = Panel(panel.x, Scale(0.0, 1.0, top + high + 32.0, top + high + 6.0))
    below.legend(('used', SERIES[0], 'line'), is_left=True)
    if any(one.refusal for one in placed):
        below.legend(('refused', SERIES[1], 'line'))
    return svg.chart([panel, below], top + high + 32.0), len(placed)


def hammer(directions: Floats) -> tuple[Floats, Floats]:
    """Hammer projection of unit vectors (n, 3), right ascension increasing to the left."""
    x, y, z = directions.T
    longitude, cos_latitude = np.arctan2(y, x), np.hypot(x, y)
    scale = np.sqrt(2.0 / (1.0 + cos_latitude * np.cos(longitude / 2)))
    return -2 * scale * cos_latitude * np.sin(longitude / 2), scale * z


def _draw_graticule(panel: Panel) -> None:
    along = np.linspace(-np.pi, np.pi, 73, dtype=np.float64)
    for hours in range(-12, 13, 3):
        longitude, latitude = np.radians(15.0 * hours * 0.99999), along / 2
        panel.line(*_lines(longitude, latitude), GRID, 1.0)
        if hours % 6 == 0 and abs(hours) < 12:
            place = _lines(longitude, np.zeros(1))
            panel.text(place[0][0], place[1][0], f'{hours % 24} h', colour=MUTED)
    for degrees in (-60, -30, 0, 30, 60):
        panel.line(*_lines(along * 0.99999, np.radians(degrees)), GRID, 1.0)
        if degrees:
            place = _lines(np.zeros(1), np.radians(degrees))
            panel.text(place[0][0], place[1][0], f'{in_digits(degrees)}°', colour=MUTED)


def _lines(longitude: Floats | float, latitude: Floats | float) -> tuple[Floats, Floats]:
    longitude, latitude = np.broadcast_arrays(longitude, latitude)
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    return hammer(np.stack([x, y, np.sin(latitude)], axis=-1))
