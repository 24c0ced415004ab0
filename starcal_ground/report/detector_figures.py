# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures over the detector and over the sky."""

from __future__ import annotations

from collections.abc import Sequence
import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ground.report import svg, verdict
from starcal_ground.residuals import Residuals
from starcal_ros import records
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import movement
from starcal_ros.camera import CameraModel, distortion_px, line_of_sight, pixel_grid
from starcal_ros.camera.detector_field import DetectorField
from starcal_ros.text import significant

FLAT = 0.02  # relative range below which a map counts as flat
_MOST_HEIGHT = 400.0
_ROUNDING_PX = 1e-9  # smaller displacements (px) and sigmas (arcsec) are rounding errors
_LEVELS = 5
_BAR = 84.0  # width, in units of the view box, for the colour bar of a map
_TOP, _BELOW = 26.0, 40.0
_DARK, _BRIGHT, _BAD = '#16202b', '#ffffff', '#a8251c'  # on maps; the same on a dark page
_SHORT = 20  # columns, of which one is the longest arrow from the middle of a cell
_FOOTPRINTS = 200  # most footprints drawn on the sky


def over_detector(camera: CameraModel, right: float = 12.0) -> svg.Panel:
    """Panel with the aspect ratio of the detector and its axes."""
    left = 54.0
    wide = svg.WIDTH - left - right
    high = wide * camera.height / camera.width
    if high > _MOST_HEIGHT:
        wide, high = wide * _MOST_HEIGHT / high, _MOST_HEIGHT
    x = svg.Scale(-0.5, camera.width - 0.5, left, left + wide)
    y = svg.Scale(-0.5, camera.height - 0.5, _TOP, _TOP + high)
    panel = svg.Panel(x, y)
    panel.axes('column u (px)', 'row v (px)', svg.named(x), svg.named(y), is_framed=True)
    return panel


def _drawn(panel: svg.Panel, *others: svg.Panel) -> svg.Drawing:
    return panel.drawing(panel.y.end + _BELOW, *others)


def star_cloud(measured_px: Floats, camera: CameraModel) -> svg.Drawing:
    """Positions (n, 2) of stars on the detector."""
    panel = over_detector(camera)
    radius = float(np.clip(60.0 / np.sqrt(max(len(measured_px), 1)), 0.7, 1.8))
    panel.cloud(measured_px, radius, 0.8)
    return _drawn(panel)


def cell_counts(stars: NDArray[np.int64], camera: CameraModel) -> svg.Chart:
    """Star counts (rows, columns) in equal cells of the detector; those of empty cells are red."""
    panel = over_detector(camera, right=_BAR)
    rows, columns = stars.shape
    most = max(int(stars.max()), 1)
    panel.picture(_coloured(np.kron(255 * stars / most, np.ones((16, 16)))))
    for (row, column), count in np.ndenumerate(stars):
        u = (column + 0.5) / columns * camera.width - 0.5
        v = (row + 0.5) / rows * camera.height - 0.5
        size = min(svg.LETTER, 124.0 / columns)
        panel.text(u, v, str(count), _DARK if count else _BAD, _BRIGHT, size)
    return svg.Chart(
        'Stars per cell',
        _drawn(panel, _bar(panel, float(most), '')),
        f'Used star observations in {stars.size} equal cells: {int(stars.min())} to '
        f'{int(stars.max())} per cell, {int((stars == 0).sum())} cells empty.',
    )


def distortion_vectors(camera: CameraModel) -> svg.Chart:
    """Distortion as arrows (paper, Fig. 6 left)."""
    places, columns = pixel_grid(camera, 17, 13), 16
    shift_px = distortion_px(camera, places)
    middle = 0.5 * (np.array([camera.width, camera.height]) - 1)
    if ((places - middle) * shift_px).sum() > 0.0:  # outwards, over the numbers of the axes
        places, columns = _middles_of_cells(camera), _SHORT
        shift_px = distortion_px(camera, places)
    return svg.Chart(
        'Distortion vectors',
        arrows(camera, places, shift_px, columns),
        'Displacement of a star from its position with an ideal lens (dot). Arrows are '
        'enlarged; the arrow above the figure is their scale.',
    )


def change_from_prior(before: records.CameraGeometry, after: records.CameraGeometry) -> svg.Chart:
    """Change of the lines of sight in pixels, common rotation removed."""
    _, moved_px = movement(before, after, 60, 48)
    return svg.Chart(
        'Change relative to the prior',
        detector_map(moved_px.reshape(48, 60), after.camera, ' px'),
        'Change of the line of sight of each pixel relative to the prior, with the common '
        f'rotation removed: at most {significant(np.nanmax(moved_px), 3)} px.',
    )


def mean_residuals(residuals: Residuals, camera: CameraModel) -> svg.Chart:
    """Mean residual in cells of the detector, which shows unmodelled distortion."""
    u, v = residuals.measured_px[residuals.used].T
    edges_u = np.linspace(-0.5, camera.width - 0.5, 13)
    edges_v = np.linspace(-0.5, camera.height - 0.5, 11)
    count, *sums = (
        np.histogram2d(u, v, (edges_u, edges_v), weights=weights)[0]
        for weights in (None, *residuals.residual_px[residuals.used].T)
    )
    enough = count >= 5
    centre_u, centre_v = (0.5 * (e[1:] + e[:-1]) for e in (edges_u, edges_v))
    places = np.stack(np.meshgrid(centre_u, centre_v, indexing='ij'), axis=-1)[enough]
    mean = np.stack([one[enough] / count[enough] for one in sums], axis=-1)
    return svg.Chart(
        'Mean residuals over the detector',
        arrows(camera, places, mean),
        'Mean residual of the stars in each cell, enlarged to the scale of the arrow above. A '
        'regular pattern indicates distortion that the lens model does not describe; noise has '
        'no pattern.',
    )


def field_vectors(field: DetectorField, camera: CameraModel) -> svg.Chart:
    """The residual field, which adds to the lens model, as arrows."""
    places = _middles_of_cells(camera)
    return svg.Chart(
        'Residual field in addition to the lens model',
        arrows(camera, places, field.displacement_px(places), _SHORT, verdict.VISIBLE_PX),
        'Displacement of a star from its position by the lens model, enlarged to the scale of '
        'the arrow above the figure.',
    )


def _middles_of_cells(camera: CameraModel) -> Floats:
    """Places (192, 2) from which arrows of the length `_SHORT` cover no number of the axes."""
    u, v = (
        (np.arange(cells) + 0.5) / cells * size - 0.5
        for cells, size in ((16, camera.width), (12, camera.height))
    )
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def arrows(
    camera: CameraModel,
    places: Floats,
    shift_px: Floats,
    columns: int = 16,
    least_px: float = _ROUNDING_PX,
) -> svg.Drawing:
    """
    Enlarged displacements (n, 2) at places (n, 2), with an arrow of a round length as scale.

    The longest is as long as one of the columns; none is drawn if all are below ``least_px``.
    """
    panel = over_detector(camera)
    longest_px = float(np.nanmax(np.hypot(*shift_px.T), initial=0.0))
    if not longest_px > least_px:
        is_any = least_px > _ROUNDING_PX
        panel.note(f'less than {least_px:g} px everywhere' if is_any else 'no displacement')
        return _drawn(panel)
    units_per_px = 0.95 * abs(panel.x.end - panel.x.start) / columns / longest_px
    starts = np.stack([panel.x(places[:, 0]), panel.y(places[:, 1])], axis=-1)
    for start, shift in zip(starts, shift_px, strict=True):
        panel.outside.append(svg.arrow(start, units_per_px * shift, svg.SERIES[0]))
    key_px = svg.round_step(longest_px / 2.5)
    along = np.array([units_per_px * key_px, 0.0])
    start = panel.x.end - along[0]
    panel.outside.append(svg.arrow(np.array([start, 13.0]), along, svg.SERIES[1]))
    panel.outside.append(svg.words(start - 7, 17, f'scale: {svg.in_digits(key_px)} px', 'end'))
    return _drawn(panel)


def line_of_sight_sigma(
    maps: records.DetectorMaps, camera: CameraModel, is_alone: bool
) -> svg.Chart:
    """1-sigma of the lines of sight, of the camera alone or with its alignment."""
    sigma = maps.shape_sigma_arcsec if is_alone else maps.line_of_sight_sigma_arcsec
    title, text = (
        ('camera alone', 'with the rotation common to all pixels removed')
        if is_alone
        else ('camera and alignment', 'in the star tracker frame')
    )
    return svg.Chart(
        f'Line of sight, {title}',
        detector_map(sigma, camera, '″'),
        f'1-sigma of the line of sight of each pixel, {text}: {significant(sigma.min(), 4)}″ to '
        f'{significant(sigma.max(), 4)}″. The colours start at zero.',
    )


def detector_map(values: Floats, camera: CameraModel, unit: str) -> svg.Drawing:
    """Colours of a grid from corner to corner, with their bar; they start at zero."""
    panel = over_detector(camera, right=_BAR)
    finite = values[np.isfinite(values)]
    low, top = (float(end) for end in (finite.min(initial=np.inf), finite.max(initial=0.0)))
    if not top > _ROUNDING_PX:
        panel.note(f'0{unit} everywhere' if len(finite) else 'unknown')
        return _drawn(panel)
    known = np.where(np.isfinite(values), values, 0.0)
    panel.picture(_coloured(cv2.resize(255 * known / top, (240, 192))))
    if top - low <= FLAT * top:
        percent = 100 * (top - low) / top
        panel.note(f'flat within {svg.in_digits(round(percent, 2))} %', _BRIGHT, _DARK)
    return _drawn(panel, _bar(panel, top, unit))


def _bar(panel: svg.Panel, top: float, unit: str) -> svg.Panel:
    """Bar of the colours beside a panel, from zero to the largest value."""
    upright = svg.Scale(0.0, top, panel.y.end, panel.y.start)
    bar = svg.Panel(svg.Scale(0, 1, panel.x.end + 12, panel.x.end + 26), upright)
    bar.picture(_coloured(np.linspace(255, 0, 128)[:, None]))
    for value in upright.ticks(_LEVELS):
        name, y = f'{svg.in_digits(value)}{unit}', float(upright(value))
        bar.outside.append(svg.words(bar.x.end + 5, y + 4, name, 'start'))
    return bar


def _coloured(levels: NDArray[Any]) -> NDArray[np.uint8]:
    """BGR picture of levels 0 to 255."""
    return np.asarray(_viridis()[np.rint(np.clip(levels, 0, 255)).astype(np.uint8)])


@functools.cache
def _viridis() -> NDArray[np.uint8]:
    """Colours (256, 3) BGR, cached because OpenCV rebuilds its table in 10 ms per picture."""
    shades = np.arange(256, dtype=np.uint8)[:, None]  # OpenCV 5 returns another shape for (256,)
    return np.asarray(cv2.applyColorMap(shades, cv2.COLORMAP_VIRIDIS)[:, 0], np.uint8)


def pointings(
    observations: Sequence[records.StarObservations], geometry: records.CameraGeometry
) -> svg.Chart | None:
    """
    Footprints of the images on the whole sky; None without an image that has an attitude.

    A Hammer projection of the ICRS, right ascension 0 in the middle and increasing to the left.
    Refused images that have an attitude are drawn too.
    """
    placed = [o for o in observations if not o.refusal or np.isfinite(o.attitude_gap_s)]
    if not placed:
        return None
    top, bottom = 8.0, 8.0 + (svg.WIDTH - 16.0) / 2
    root2 = np.sqrt(2)
    panel = svg.Panel(
        svg.Scale(-2 * root2, 2 * root2, 8.0, svg.WIDTH - 8.0),
        svg.Scale(-root2, root2, bottom, top),
    )
    _draw_graticule(panel)
    camera = geometry.camera
    edge, end = np.linspace(-0.5, 0.5, 9), np.full(9, 0.5)
    sides = [(edge, -end), (end, edge), (edge[::-1], end), (-end, edge[::-1])]
    border = np.concatenate([np.stack(side, axis=-1) for side in sides])
    in_camera = line_of_sight(camera, (border + 0.5) * [camera.width, camera.height] - 0.5)
    in_tracker = geometry.star_tracker_from_camera.apply(in_camera)
    every = -(-len(placed) // _FOOTPRINTS) or 1
    for one in placed[::every]:
        seen = Rotation.from_quat(one.icrf_from_star_tracker_xyzw).apply(in_tracker)
        x, y = hammer(np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(np.clip(seen[:, 2], -1, 1)))
        # A line across the edge of the map would cross the whole map.
        x = np.where(np.abs(np.diff(x, prepend=x[:1])) > 2.0, np.nan, x)
        panel.curve(svg.Curve(x, y, svg.SERIES[1 if one.refusal else 0], width=1.2))
    below = svg.Panel(panel.x, svg.Scale(0.0, 1.0, bottom + 32.0, bottom + 6.0))
    below.legend([svg.Curve([], [], svg.SERIES[0], 'used')], is_left=True)
    if any(one.refusal for one in placed):
        below.legend([svg.Curve([], [], svg.SERIES[1], 'refused')])
    text = (
        f'Footprints of {len(placed)} images on the whole sky (ICRS, Hammer projection, right '
        'ascension to the left).'
    )
    return svg.Chart('Pointings', panel.drawing(bottom + 32.0, below), text)


def hammer(longitude: Floats | float, latitude: Floats | float) -> tuple[Floats, Floats]:
    """Hammer projection of places in rad, longitude increasing to the left."""
    scale = np.sqrt(2.0 / (1.0 + np.cos(latitude) * np.cos(longitude / 2)))
    return -2 * scale * np.cos(latitude) * np.sin(longitude / 2), scale * np.sin(latitude)


def _draw_graticule(panel: svg.Panel) -> None:
    along = np.linspace(-np.pi, np.pi, 73, dtype=np.float64)
    for hours in range(-12, 13, 3):
        x, y = hammer(np.radians(15.0 * hours * 0.99999), along / 2)
        panel.curve(svg.Curve(x, y, svg.GRID, width=1.0))
        if hours % 6 == 0 and abs(hours) < 12:
            panel.text(x[36], y[36], f'{hours % 24} h', svg.MUTED)
    for degrees in (-60, -30, 0, 30, 60):
        x, y = hammer(along * 0.99999, np.radians(degrees))
        panel.curve(svg.Curve(x, y, svg.GRID, width=1.0))
        if degrees:
            panel.text(x[36], y[36], f'{svg.in_digits(degrees)}°', svg.MUTED)
