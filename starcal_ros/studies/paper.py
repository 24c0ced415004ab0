"""
The paper shown again: its night simulated, calibrated from few images, judged on the others.

The 359 frames of the scenario `paper` are drawn pixel by pixel and measured as any image is.  What
the paper says of its own night stands beside in the page that `page` makes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import functools

import jinja2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.assessment.gate import GateOptions
from starcal_ros.assessment.observability import map_error_px
from starcal_ros.assessment.term_removal import removal_study
from starcal_ros.camera import CameraModel, distortion_px, line_of_sight, pixel_grid, project
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import CalibrationOptions, Estimate, estimate_calibration
from starcal_ros.estimation.normal_equations import squared_sigmas, star_table
from starcal_ros.estimation.problem import METHODS
from starcal_ros.identification.star_finder import IdentificationOptions
from starcal_ros.image.centroiding import CentroidOptions
from starcal_ros.image.frame_checks import ScreeningOptions
from starcal_ros.image.hot_pixels import FixedPatternOptions
from starcal_ros.pipeline.observe import observe
from starcal_ros.pipeline.setup import Setup, SetupOptions
from starcal_ros.records import Ensemble, Removal, StarObservations
from starcal_ros.simulation.images import fixed_pattern, render
from starcal_ros.simulation.scenario import attitude_samples, Scenario, scenario, scene
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.attitude import AttitudeHistory, AttitudeOptions
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.studies.monte_carlo import Campaign, Design, Row

NIGHT = 'paper'
CALIBRATED_WITH = 15
TABLE_1 = Design('table1', 20, (15,), (80,), (0.0, 5.0, 20.0, 60.0), METHODS)
_COUNTS = (2, 3, 4, 5, 7, 10, 15, 20, 30, 60, 120)
# As Fig. 8 does; the first to go are those that can hardly be told from the pointing.
_ALL_TERMS = ('fx', 'skew', 'fy', 'cx', 'cy', 'k1', 'k2', 'k3', 'p1', 'p2')


@dataclass(frozen=True)
class Judged:
    """
    Residuals of images that a calibration may have seen or not, each turned to fit; n stars.

    ``image`` (n,) counts from 0; ``residual_px`` (n, 2); ``fits`` (n,) bool is False for a star
    beyond the outlier limit.
    """

    image: NDArray[np.int64]
    measured_px: Floats
    residual_px: Floats
    fits: NDArray[np.bool_]

    def rms_px(self, images: Sequence[int]) -> float:
        """RMS per axis over the stars that fit of some images."""
        here = self.fits & np.isin(self.image, images)
        return float(np.sqrt(np.mean(self.residual_px[here] ** 2)))

    def std_of_images_px(self) -> Floats:
        """Standard deviation (m, 2) of u and v of each image, over the stars that fit."""
        return np.array(
            [
                self.residual_px[self.fits & (self.image == k)].std(axis=0)
                for k in range(int(self.image.max()) + 1)
            ]
        )


@dataclass(frozen=True)
class PaperStudy:
    """
    What came of the night.

    Attributes
    ----------
    camera, true_camera : CameraModel
        Of ``per_image``, the paper's Method 1, with `CALIBRATED_WITH` images; and the truth.
    used : tuple of int
        Those images, evenly spread over the night.
    judged : Judged
        All images with that camera.
    noise_rms_px : float
        The same residual of the other images with the true camera.
    methods, counts : tuple of mapping
        A row for each method, and for each number of images: residuals of the other images, error
        of the map of the lines of sight.
    removals : tuple of Removal
        Fig. 8 of the same images.
    table1 : Campaign
    """

    seed: int
    images: int
    refused: int
    stars: int
    camera: CameraModel
    true_camera: CameraModel
    used: tuple[int, ...]
    judged: Judged
    noise_rms_px: float
    methods: tuple[Row, ...]
    counts: tuple[Row, ...]
    removals: tuple[Removal, ...]
    table1: Campaign


@functools.lru_cache(maxsize=1)
def setup_of(seed: int) -> Setup:
    """What is known before: the options as they are by default, and the prior of the scenario."""
    night = scenario(NIGHT, seed)
    identification = IdentificationOptions()
    return Setup(
        frames=SetupOptions(),
        attitude=AttitudeOptions(),
        site=SiteOptions(),
        screening=ScreeningOptions(),
        fixed_pattern=FixedPatternOptions(),
        centroid=CentroidOptions(),
        identification=identification,
        calibration=CalibrationOptions(
            star_tracker_sigma_arcsec=night.star_tracker_sigma_arcsec,
        ),
        gate=GateOptions(),
        prior=night.prior,
        catalog=load_catalog(None, identification.magnitude_limit),
        dark=None,
    )


@functools.lru_cache(maxsize=1)
def _night_and_pattern(seed: int) -> tuple[Scenario, Floats]:
    night = scenario(NIGHT, seed)
    return night, fixed_pattern(night)


def observe_frame(seed: int, index: int) -> StarObservations:
    """The stars of a frame of the night, measured in its pixels."""
    night, pattern = _night_and_pattern(seed)
    setup = setup_of(seed)
    attitudes = AttitudeHistory()
    for sample in attitude_samples(night, index):
        attitudes.add(sample.time_ns, sample)
    image = render(night, scene(night, index), index, pattern)
    return observe(image, attitudes, setup, setup.prior)


def judge(camera: CameraModel, images: Sequence[StarObservations], outlier_sigma: float) -> Judged:
    """Residuals of images with a camera, each turned to fit its own stars (as in Fig. 7)."""
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
    """At most so many of a count, evenly over all of them."""
    return tuple(sorted({round(k) for k in np.linspace(0, most - 1, min(count, most))}))


def study(observations: Sequence[StarObservations], table1: Campaign, seed: int) -> PaperStudy:
    """
    The paper's figures from the observations of a night.

    Raises
    ------
    TooFewObservations
        When too few images were measured.
    """
    setup, truth = setup_of(seed), scenario(NIGHT, seed).truth
    images = [observed for observed in observations if not observed.refusal]
    count = len(images)
    limit = setup.calibration.outlier_sigma

    def solve(chosen: Sequence[int], **changed: object) -> Estimate:
        options = dataclasses.replace(
            setup.calibration,
            min_images=2,
            **changed,  # type: ignore[arg-type]
        )
        ensemble = Ensemble(tuple(images[k] for k in chosen))
        return estimate_calibration(ensemble, setup.prior, options)

    def row(estimate: Estimate, chosen: Sequence[int]) -> Row:
        camera = estimate.geometry.camera
        others = sorted(set(range(count)) - set(chosen))
        return {
            'used_px': float(np.sqrt(np.mean(estimate.residual_px[estimate.kept] ** 2))),
            'others_px': judge(camera, images, limit).rms_px(others),
            'map_error_px': map_error_px(camera, truth.camera),
            'scatter_arcsec': estimate.alignment_scatter_arcsec,
            'sigma_fx_px': float(np.sqrt(estimate.covariance[0, 0])),
        }

    used = spread(CALIBRATED_WITH, count)
    estimates = {method: solve(used, method=method) for method in METHODS}
    camera = estimates['per_image'].geometry.camera
    others = sorted(set(range(count)) - set(used))
    return PaperStudy(
        seed=seed,
        images=len(observations),
        refused=len(observations) - count,
        stars=sum(len(observed) for observed in images),
        camera=camera,
        true_camera=truth.camera,
        used=used,
        judged=judge(camera, images, limit),
        noise_rms_px=judge(truth.camera, images, limit).rms_px(others),
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
    """What the page says, as numbers."""
    distortion = np.hypot(*distortion_px(found.camera, pixel_grid(found.camera, 60, 48)).T)
    judged = found.judged
    others = sorted(set(range(found.images - found.refused)) - set(found.used))
    of_others = judged.fits & np.isin(judged.image, others)
    at_least = found.removals[0].residual_rms_px
    return {
        'seed': found.seed,
        'images': found.images,
        'refused': found.refused,
        'stars': found.stars,
        'used': len(found.used),
        'others': len(others),
        'distortion_px': (float(distortion.min()), float(distortion.max())),
        'others_std_px': judged.residual_px[of_others].std(axis=0).tolist(),
        'others_rms_px': judged.rms_px(others),
        'noise_rms_px': found.noise_rms_px,
        'image_std_px': (
            float(judged.std_of_images_px().min()),
            float(judged.std_of_images_px().max()),
        ),
        'outliers': int((~judged.fits).sum()),
        'methods': found.methods,
        'counts': found.counts,
        'removals': [
            {
                'removed': removal.removed or 'none',
                'std_px': removal.residual_std_px,
                'rise_percent': 100 * (removal.residual_rms_px / at_least - 1),
                'map_change_px': removal.map_change_px,
            }
            for removal in found.removals
        ],
        'table1': found.table1.summary,
        'trials': found.table1.design.trials,
        'arcsec_per_px': 1.0 / found.camera.parameters[0] / ARCSECOND_RAD,
    }


def page(found: PaperStudy, software: str) -> str:
    """A page in Markdown: what the paper reports, what came of it here, and how they differ."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('starcal_ros.report'),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # Markdown, and nothing in it comes from outside
    )
    return environment.get_template('paper.md').render(software=software, **numbers(found))
