# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
From pixels to a calibration, against the Cramer-Rao bound: cameras, PSF widths, star trackers.

Every seed renders a campaign, measures it with `observe.observe_next`, solves it, and compares the
lines of sight over the detector with the truth after removal of the best common rotation.  The
bound uses every star above a signal-to-noise ratio of 5 with the attitude of each image free.  One
draw scatters by about 30 %; the figure is the rms over the seeds.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from dataclasses import dataclass
import math

import numpy as np

from bench.frames import load_set_up, observed, render_frame
from bench.table import Table
from bench.trials import in_processes, rms
from starcal_ground.simulation import centroids
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.observability import map_error_px
from starcal_ros.errors import TooFewObservations
from starcal_ros.pipeline import solve
from starcal_ros.records import CameraGeometry, MapCovariance, StarObservations
from studies.trials import map_bound_px

SIZE = (1296, 1024)
IMAGES = 8
SEEDS = 40
TARGET = 1.15
_APART_S = 1800.0  # from image to image: another sky each


@dataclass(frozen=True)
class Case:
    """A camera, its stars and its star tracker."""

    field_deg: float
    psf_sigma_px: float
    tracker_arcsec: float


CASES = (
    *(Case(20.0, psf_sigma_px, 20.0) for psf_sigma_px in (0.95, 0.7, 1.4, 2.0)),
    *(Case(6.0, psf_sigma_px, 5.0) for psf_sigma_px in (0.95, 2.0)),
    *(Case(12.0, 1.2, 60.0), Case(40.0, 0.95, 20.0), Case(40.0, 0.7, 5.0)),
)


def run(quick: bool) -> Iterator[Table]:
    """Run every case over its seeds."""
    cases, seeds = (CASES[:1], 2) if quick else (CASES, SEEDS)
    columns = (
        'field deg, PSF px, tracker ", map / bound rms, median, worst, target, '
        'its sigma / bound, star / bound, star / sigma, stars, not solved'
    )
    table = Table(
        f'From pixels, {IMAGES} images of {SIZE[0]} x {SIZE[1]}, {seeds} seeds',
        columns.split(', '),
        notes=[
            'map: rms over the detector after the best common rotation; its sigma: the same from',
            'the covariance of the calibration.  star: rms error per axis over the bound of each',
            'star and over its own sigma, signal-to-noise above 10.',
            'not solved: campaigns without a calibration, not included in the other columns.',
        ],
    )
    for case in cases:
        rows = in_processes(trial, [case] * seeds, range(1, seeds + 1))
        table.add(*_summary(case, np.array(rows)))
        print(*table.rows[-1], flush=True)
    yield table


def _summary(case: Case, table: Floats) -> tuple[float | str, ...]:
    solved = np.isfinite(table).all(axis=1)
    unsolved = int(np.count_nonzero(~solved))
    before = (case.field_deg, case.psf_sigma_px, case.tracker_arcsec)
    if not solved.any():
        return (*before, *([math.nan] * 3), 'MISSED', *([math.nan] * 3), 0, unsolved)
    ratio, told_ratio, over_bound2, over_sigma2, stars = table[solved].T
    verdict = 'met' if rms(ratio) <= TARGET and not unsolved else 'MISSED'
    return (
        *(*before, rms(ratio), float(np.median(ratio)), float(ratio.max()), verdict),
        *(float(told_ratio.mean()), math.sqrt(float(over_bound2.mean()))),
        *(math.sqrt(float(over_sigma2.mean())), int(stars.mean()), unsolved),
    )


def scenario_of(case: Case, seed: int) -> Scenario:
    """Campaign of a case: the camera of `scenario.scenario` with another lens."""
    base = synthetic.scenario('small', seed)
    assert (base.truth.camera.width, base.truth.camera.height) == SIZE
    focal_px = SIZE[0] / 2 / math.tan(math.radians(case.field_deg / 2))

    def lens(geometry: CameraGeometry) -> CameraGeometry:
        camera = geometry.camera
        scale = focal_px / base.prior.camera.parameters[0]
        fx, _, fy = camera.intrinsics[:3]
        # The same distortion at the edge of the detector, in pixels, whatever the focal length.
        k1, k2, k3, p1, p2 = camera.distortion * scale ** np.array([2, 4, 6, 1, 1])
        fitted = camera.replace(fx=fx * scale, fy=fy * scale, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
        return dataclasses.replace(geometry, camera=fitted)

    # A longer lens of the same f-number gathers more light.
    light = max(1.0, focal_px / base.prior.camera.parameters[0]) ** 2
    detector = dataclasses.replace(
        base.detector,
        psf_sigma_px=case.psf_sigma_px,
        zero_point_electrons=light * base.detector.zero_point_electrons,
    )
    return dataclasses.replace(
        base,
        truth=lens(base.truth),
        prior=lens(base.prior),
        detector=detector,
        star_tracker_sigma_arcsec=(case.tracker_arcsec,) * 3,
        start_ns=base.start_ns + seed * 4_001_000_000_000,
        cadence_s=_APART_S,
        image_count=IMAGES,
    )


def trial(case: Case, seed: int) -> Floats:
    """
    Map error and its sigma over the bound, squared star errors over bound and sigma, count: (5,).

    NaN if the campaign gives no calibration.
    """
    scenario = scenario_of(case, seed)
    setup = load_set_up(scenario)
    frames = [render_frame(scenario, index) for index in range(scenario.image_count)]
    ensemble = observed(frames, setup, has_velocity=False)
    index = {image.time_ns: k for k, (image, _) in enumerate(frames)}
    stars = [_star_errors(scenario, index[one.time_ns], one) for one in ensemble.images]
    try:
        found = solve.solve(ensemble, setup)
    except TooFewObservations:
        return np.full(5, np.nan)
    bound = np.zeros((13, 13))
    names = centroids.bound_names(scenario.truth.camera)
    columns = [found.parameter_names.index(name) for name in names]
    bound[np.ix_(columns, columns)] = centroids.cramer_rao_covariance(scenario)
    error_px = map_error_px(found.geometry.camera, scenario.truth.camera)
    over_bound2, over_sigma2 = np.concatenate(stars, axis=1).mean(axis=1)
    bound_px = map_bound_px(scenario.truth.camera, MapCovariance(bound))
    sigma_px = map_bound_px(found.geometry.camera, found.map_covariance)
    over_px = (error_px / bound_px, sigma_px / bound_px)
    return np.array([*over_px, over_bound2, over_sigma2, found.stars_used])


def _star_errors(scenario: Scenario, index: int, stars: StarObservations) -> Floats:
    """Squared errors (2, n) per axis by bound and by reported sigma, of the brighter stars."""
    shown = synthetic.scene(scenario, index)
    order = np.argsort(shown.catalog_id)
    row = order[np.searchsorted(shown.catalog_id[order], stars.catalog_id)]
    camera = scenario.truth.camera
    stars_of_scene = (shown.pixel_px[row], shown.flux_electrons[row])
    shape = (camera.height, camera.width)
    covariance, snr = centroids.centroid_bound(*stars_of_scene, scenario.detector, shape)
    squared = (stars.measured_px - shown.pixel_px[row]) ** 2
    by_bound = squared / covariance[:, [0, 1], [0, 1]]
    by_sigma = squared / stars.covariance_px2[:, [0, 2]]
    return np.stack([by_bound[snr > 10].mean(axis=1), by_sigma[snr > 10].mean(axis=1)])
