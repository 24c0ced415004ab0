# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Reproduction of the paper: its night is simulated, and calibrated from a few of the images.

The 359 frames of the scenario `paper` are rendered and measured like any image.  `page` compares
the results with those of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import functools
from pathlib import Path

import jinja2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from starcal_ground.comparison import map_error_px
from starcal_ground.report import svg
from starcal_ground.report.detector_figures import detector_map, distortion_vectors, star_cloud
from starcal_ground.report.figures import outline
from starcal_ground.report.svg import Curve, Drawing, Panel, plot, SERIES, sheet
from starcal_ground.simulation.rendering import fixed_pattern, render
from starcal_ground.simulation.scenario import attitude_samples, Scenario, scenario, scene
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, distortion_px, line_of_sight, pixel_grid, project
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.problem import METHODS
from starcal_ros.estimation.star_equations import squared_sigmas, star_table
from starcal_ros.pipeline.observe import observe_next
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.sky.attitude import AttitudeHistory
from studies.monte_carlo import Design, Row, StudyResult
from studies.term_removal import removal_study, TermRemoval
from studies.trials import PAPER_ESTIMATE, rms

NIGHT = 'paper'
CALIBRATED_WITH = 15
TABLE_1 = Design('table1', 20, (15,), (80,), (0.0, 5.0, 20.0, 60.0), METHODS)
_COUNTS = (2, 3, 4, 5, 7, 10, 15, 20, 30, 60, 120)
# As in Fig. 8; terms nearly indistinguishable from the pointing are removed first.
_ALL_TERMS = ('fx', 'skew', 'fy', 'cx', 'cy', 'k1', 'k2', 'k3', 'p1', 'p2')


@dataclass(frozen=True)
class Judged:
    """
    Residuals of images with a camera, each at its best-fit rotation; n stars.

    ``image`` (n,) counts from 0; ``measured_px``, ``residual_px`` (n, 2); ``fits`` (n,) bool is
    False for outliers.
    """

    image: NDArray[np.int64]
    measured_px: Floats
    residual_px: Floats
    fits: NDArray[np.bool_]

    def rms_px(self, images: Sequence[int]) -> float:
        """RMS per axis over the stars of some images, without outliers."""
        here = self.fits & np.isin(self.image, images)
        return rms(self.residual_px[here])

    def std_of_images_px(self) -> Floats:
        """Standard deviation (m, 2) of u and v of each image, without outliers."""
        images = range(int(self.image.max()) + 1)
        fitting = (self.residual_px[self.fits & (self.image == k)] for k in images)
        return np.array([residual_px.std(axis=0) for residual_px in fitting])


@dataclass(frozen=True)
class PaperStudy:
    """
    Results of the simulated night.

    Attributes
    ----------
    camera : CameraModel
        Estimated by ``per_image``, the paper's Method 1, from `CALIBRATED_WITH` images.
    used, others : tuple of int
        Indices of those images, evenly spread over the night, and of the other measured ones.
    judged : Judged
        Residuals of all images with the estimated camera.
    noise_rms_px : float
        RMS residual of the other images with the true camera.
    methods, counts : tuple of mapping
        A row for each method, and for each number of images: residuals of the other images, error
        of the map of the lines of sight.
    removals : tuple of TermRemoval
        Fig. 8, from the same images.
    table1 : StudyResult
    """

    seed: int
    images: int
    refused: int
    stars: int
    camera: CameraModel
    used: tuple[int, ...]
    others: tuple[int, ...]
    judged: Judged
    noise_rms_px: float
    methods: tuple[Row, ...]
    counts: tuple[Row, ...]
    removals: tuple[TermRemoval, ...]
    table1: StudyResult


@functools.lru_cache(maxsize=1)
def setup_of(seed: int) -> Setup:
    """The paper's lens model, without a field, and the prior of the scenario."""
    night = scenario(NIGHT, seed)
    values: dict[str, object] = {
        'estimate': PAPER_ESTIMATE,
        'star_tracker_sigma_arcsec': night.star_tracker_sigma_arcsec,
        # Of the scenario: the directions have the velocity of the Earth.
        'velocity_sigma_m_s': 0.0,
        'shutter': 'global',
        'stamp_sigma_s': 0.0,
    }
    setup = load_setup(values, prior=night.prior)
    options = dataclasses.replace(setup.calibration, principal_point_prior=0.0, lens_prior=0.0)
    return dataclasses.replace(setup, calibration=options)


@functools.lru_cache(maxsize=1)
def _night_and_pattern(seed: int) -> tuple[Scenario, Floats]:
    night = scenario(NIGHT, seed)
    return night, fixed_pattern(night)


def observe_frame(seed: int, index: int) -> StarObservations:
    """Observations of a frame of the night, measured in its rendered pixels."""
    night, pattern = _night_and_pattern(seed)
    setup = setup_of(seed)
    attitudes = AttitudeHistory()
    for sample in attitude_samples(night, index):
        attitudes.add(sample.time_ns, sample)
    image = render(night, scene(night, index), index, pattern)
    return observe_next(image, attitudes, setup)[0]


def observe_frame_of(seed: int, images: int, index: int) -> StarObservations:
    """Observations of one of some frames that are spread evenly over the night."""
    return observe_frame(seed, spread(images, scenario(NIGHT, seed).image_count)[index])


def judge(camera: CameraModel, images: Sequence[StarObservations], outlier_sigma: float) -> Judged:
    """Residuals of images with a camera, each at its best-fit rotation (as in Fig. 7)."""
    table = star_table(images)
    residual_px = np.empty_like(table.measured_px)
    weight = 1.0 / (table.covariance_px2[:, 0] + table.covariance_px2[:, 2])
    sight = line_of_sight(camera, table.measured_px)
    first = 0
    for observed in images:
        here = slice(first, first + len(observed))
        first = here.stop
        directions = table.direction_icrf[here]
        rotation, _ = Rotation.align_vectors(sight[here], directions, weight[here])
        residual_px[here] = table.measured_px[here] - project(camera, rotation.apply(directions))
    fits = squared_sigmas(residual_px, table.covariance_px2) < outlier_sigma**2
    return Judged(table.image, table.measured_px, residual_px, fits)


def spread(count: int, most: int) -> tuple[int, ...]:
    """``count`` evenly spaced indices below ``most``, or all of them if fewer."""
    return tuple(sorted({round(k) for k in np.linspace(0, most - 1, min(count, most))}))


@one_blas_thread()
def study(observations: Sequence[StarObservations], table1: StudyResult, seed: int) -> PaperStudy:
    """
    Results of the paper's figures from the observations of a night.

    Raises TooFewObservations when too few images were measured.
    """
    setup, truth = setup_of(seed), scenario(NIGHT, seed).truth
    images = [observed for observed in observations if not observed.refusal]
    count = len(images)
    limit = setup.calibration.outlier_sigma

    def solve(chosen: Sequence[int], **changed: object) -> Estimate:
        options = dataclasses.replace(setup.calibration, min_images=2, **changed)  # type: ignore[arg-type]
        ensemble = Ensemble(tuple(images[k] for k in chosen))
        return estimate_calibration(ensemble, setup.prior, options)

    def rest(chosen: Sequence[int]) -> tuple[int, ...]:
        return tuple(sorted(set(range(count)) - set(chosen)))

    def row(estimate: Estimate, chosen: Sequence[int]) -> Row:
        camera = estimate.geometry.camera
        return {
            'used_px': rms(estimate.residual_px[estimate.kept]),
            'others_px': judge(camera, images, limit).rms_px(rest(chosen)),
            'map_error_px': map_error_px(camera, truth.camera),
        }

    used = spread(min(CALIBRATED_WITH, count - 1), count)  # the others judge the result
    estimates = {method: solve(used, method=method) for method in METHODS}
    camera = estimates['per_image'].geometry.camera
    return PaperStudy(
        seed=seed,
        images=len(observations),
        refused=len(observations) - count,
        stars=sum(len(observed) for observed in images),
        camera=camera,
        used=used,
        others=rest(used),
        judged=judge(camera, images, limit),
        noise_rms_px=judge(truth.camera, images, limit).rms_px(rest(used)),
        methods=tuple({'method': m, **row(e, used)} for m, e in estimates.items()),
        counts=tuple(
            {'images': n, **row(solve(spread(n, count), method='per_image'), spread(n, count))}
            for n in _COUNTS
            if n < count
        ),
        removals=removal_study(solve(used, method='per_image', estimate=_ALL_TERMS)),
        table1=table1,
    )


def numbers(found: PaperStudy) -> Mapping[str, object]:
    """Numbers on the page, by name."""
    distortion = np.hypot(*distortion_px(found.camera, pixel_grid(found.camera, 60, 48)).T)
    judged = found.judged
    of_others = judged.fits & np.isin(judged.image, found.others)
    image_std_px = judged.std_of_images_px()
    all_terms_px = found.removals[0].residual_rms_px
    return {
        'seed': found.seed,
        'images': found.images,
        'refused': found.refused,
        'stars': found.stars,
        'used': len(found.used),
        'others': len(found.others),
        'distortion_px': (float(distortion.min()), float(distortion.max())),
        'others_std_px': judged.residual_px[of_others].std(axis=0).tolist(),
        'others_rms_px': judged.rms_px(found.others),
        'noise_rms_px': found.noise_rms_px,
        'image_std_px': (float(image_std_px.min()), float(image_std_px.max())),
        'outliers': int((~judged.fits).sum()),
        'methods': found.methods,
        'counts': found.counts,
        'removals': [
            {
                'removed': removal.removed or 'none',
                'std_px': removal.residual_std_px,
                'rise_percent': 100 * (removal.residual_rms_px / all_terms_px - 1),
                'map_change_px': removal.map_change_px,
            }
            for removal in found.removals
        ],
        'table1': found.table1.summary,
        'trials': found.table1.design.trials,
    }


def page(found: PaperStudy, software: str) -> str:
    """Page in Markdown that compares the results with those of the paper."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # Markdown, without external input
    )
    return environment.get_template('paper.md').render(software=software, **numbers(found))


def svgs(found: PaperStudy) -> Mapping[str, str]:
    """Text of the SVG file of each figure, by name."""
    camera = found.camera
    length_px = np.hypot(*distortion_px(camera, pixel_grid(camera, 60, 48)).T).reshape(48, 60)
    distortion = [distortion_vectors(camera).svg, detector_map(length_px, camera, ' px')]
    stars = f'{found.stars:,} star centroids in {found.images - found.refused} images'
    drawn = {
        'figure_5': sheet([[star_cloud(found.judged.measured_px, camera)]], stars),
        'figure_6': sheet([distortion], 'distortion: vectors, enlarged, and magnitude'),
        'figure_7': sheet([[_images(found), _histogram(found)], [_plane(found), _counts(found)]]),
    }
    return {name: figure.document() for name, figure in drawn.items()}


def _images(found: PaperStudy) -> Drawing:
    spread = found.judged.std_of_images_px()
    number = np.arange(1, len(spread) + 1)
    curves = [
        Curve(number, values, colour, name, 'circle', width=0, size=1.4)
        for values, colour, name in zip(spread.T, SERIES, 'uv', strict=False)
    ]
    used = f'{len(found.used)} images used'
    curves.append(Curve([], [], svg.GRID, used, width=4.0))

    def lines(panel: Panel) -> None:
        for at in found.used:
            panel.upright(at + 1)

    return plot(curves, 'image', 'standard deviation (px)', y=(0.0, None), under=lines)


def _histogram(found: PaperStudy) -> Drawing:
    residual_px = found.judged.residual_px[found.judged.fits]
    edges = np.linspace(-1, 1, 101, dtype=np.float64)
    curves = [
        outline(values, edges, colour, f'{name}: std {values.std():.3f} px')
        for values, colour, name in zip(residual_px.T, SERIES, 'uv', strict=False)
    ]
    normal = norm.pdf(edges, scale=float(residual_px.std()))
    curves.append(Curve(edges, normal, svg.INK, 'normal distribution', width=1.0, dash='5 3'))
    return plot(curves, 'residual (px)', 'density', x=(-1.0, 1.0), y=(0.0, None))


def _plane(found: PaperStudy) -> Drawing:
    """Residuals of v against those of u, where dots overlap darker."""
    residual_px = found.judged.residual_px[found.judged.fits]
    end = 3.5 * float(residual_px.std())
    return plot([], 'residual of u (px)', 'residual of v (px)', x=(-end, end), y=(-end, end),
                under=lambda panel: panel.cloud(residual_px, 0.7, 0.12))  # fmt: skip


def _counts(found: PaperStudy) -> Drawing:
    number = [float(row['images']) for row in found.counts]
    curves = [
        Curve(number, [float(row[name]) for row in found.counts], colour, words, 'circle')
        for name, colour, words in (
            ('others_px', SERIES[0], 'residual of the other images'),
            ('map_error_px', SERIES[1], 'map error'),
        )
    ]
    noise = [found.noise_rms_px, found.noise_rms_px]
    curves.append(
        Curve(
            [number[0], number[-1]], noise, svg.INK, 'with the true camera', dash='5 3', width=1.0
        )
    )
    return plot(curves, 'images used', 'rms (px)', log='xy',
                under=lambda panel: panel.upright(CALIBRATED_WITH, width=5.0))  # fmt: skip
