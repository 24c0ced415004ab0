# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Monte Carlo studies of calibrations with known truth.

The random numbers of a trial depend only on (seed, study, trial), so the rows of a study do not
depend on the number of workers or the order of the trials.  Lengths are pixels at the focal length
(28 arcsec) unless the name has another unit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import dataclasses
from dataclasses import dataclass
import itertools
import math
import zlib

import numpy as np

from starcal_ground.simulation.centroids import true_observations
from starcal_ros.assessment.agreement import parameter_difference
from starcal_ros.assessment.observability import map_error_px
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.records import ALIGNMENT_NAMES, Ensemble
from studies.term_removal import removal_study
from studies.trials import (
    bound,
    calibration_options,
    draw_scenario,
    draw_star_field,
    ESTIMATED,
    information_blocks,
    map_bound_px,
    normalised_error_squared,
    observe,
    pointing_bound_arcsec,
    pointing_error_arcsec,
    StarField,
    unused_residual_px,
)

Row = dict[str, 'int | float | str']

OUTLIER_SHARE = 0.02
UNUSED_IMAGES = 20
ENOUGH = 1.01  # limit on the residual of unused images relative to that with the true camera
NIGHT_S = 3590.0  # from the first image to the last (paper: 359 at ten seconds)


@dataclass(frozen=True)
class Design:
    """
    Design of a study, which has one cell for each combination of the lists.

    ``assumed_arcsec`` is the star tracker sigma that the calibration assumes; None: the true one.
    """

    study: str
    trials: int
    images: tuple[int, ...]
    stars: tuple[int, ...]
    tracker_arcsec: tuple[float, ...]
    methods: tuple[str, ...]
    assumed_arcsec: float | None = None
    seed: int = 1

    def assumed(self, tracker_arcsec: float) -> float:
        """Star tracker sigma that the calibration assumes, given the true one."""
        return tracker_arcsec if self.assumed_arcsec is None else self.assumed_arcsec


_METHODS = ('per_image', 'single', 'hierarchical')  # in the order of the paper
STUDIES: Mapping[str, tuple[str, Design]] = {
    'table1': (
        'map error of each method against star tracker noise (Table 1)',
        Design('table1', 200, (16,), (8, 80), (0.0, 5.0, 10.0, 20.0, 40.0, 60.0), _METHODS),
    ),
    'images': (
        'number of images needed (Fig. 7)',
        Design(
            'images',
            100,
            (2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 60),
            (80,),
            (20.0,),
            ('per_image', 'hierarchical'),
        ),
    ),
    'terms': (
        'residual as terms are removed one after another (Fig. 8)',
        Design('terms', 20, (15,), (), (20.0,), ('per_image',)),
    ),
    'coverage': (
        'errors relative to the reported covariance',
        Design('coverage', 200, (16,), (80,), (20.0,), ('per_image', 'hierarchical')),
    ),
}
"""Name -> title and default design."""


_LIMITS = {
    'trials': (1, 10**6),
    'seed': (0, math.inf),
    'images': (2, 1000),
    'stars': (3, 1000),
    'tracker_arcsec': (0, 3600),
    'assumed_arcsec': (0, 3600),
}
_OPTIONS = {'tracker_arcsec': 'tracker', 'assumed_arcsec': 'tracker-assumed'}  # or by field


def check(design: Design) -> None:
    """Raise OptionError for values out of range, duplicates, and a list that the study ignores."""
    for name, (low, high) in _LIMITS.items():
        values = getattr(design, name)
        for value in values if isinstance(values, tuple) else (values,):
            if value is not None and not low <= value <= high:  # nor is NaN
                raise OptionError(
                    f'--{_OPTIONS.get(name, name)}: {value:g} is not within {low:g} to {high:g}'
                )
    if design.study == 'terms' and design.stars:
        raise OptionError(
            '--stars: not applicable to the study terms, which uses the stars of the catalog'
        )
    for name in ('images', 'stars', 'tracker_arcsec', 'methods'):
        values = getattr(design, name)
        if len(set(values)) < len(values):
            raise OptionError(
                f'--{_OPTIONS.get(name, name)}: duplicate values: {" ".join(map(str, values))}'
            )


def run_trial(design: Design, trial: int) -> tuple[Row, ...]:
    """Rows of one trial, one for each cell and method; none if no calibration was possible."""
    rng = np.random.default_rng([design.seed, zlib.crc32(design.study.encode()), trial])
    rows = _TRIALS[design.study](design, rng)
    return tuple({'trial': trial, **row} for row in rows)


def _cells(design: Design, field: StarField) -> Iterable[tuple[Row, StarField]]:
    """Numbers of images and stars of each cell, and the corresponding subset of a field."""
    for images, stars in itertools.product(design.images, design.stars):
        yield {'images': images, 'stars': stars}, field.part(0, images, stars)


def _solutions(
    design: Design, cell: Row, ensemble: Ensemble, field: StarField, tracker_arcsec: float
) -> Iterable[tuple[Row, Estimate]]:
    """Key with errors, and estimate, of each method that has enough observations."""
    for method in design.methods:
        options = calibration_options(method, design.assumed(tracker_arcsec))
        try:
            estimate = estimate_calibration(ensemble, field.prior, options)
        except TooFewObservations:
            continue
        yield (
            {
                **cell,
                'tracker_arcsec': tracker_arcsec,
                'method': method,
                'map_px': map_error_px(estimate.geometry.camera, field.truth.camera),
                'pointing_arcsec': pointing_error_arcsec(estimate.geometry, field.truth),
                'normalised': normalised_error_squared(estimate, field.truth),
                'converged': int(estimate.termination == 'converged'),
            },
            estimate,
        )


def _table1_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """Each method at each star tracker noise, with the bound under its own assumptions."""
    field = draw_star_field(rng, max(design.images), max(design.stars))
    camera = field.truth.camera
    for cell, part in _cells(design, field):
        blocks = information_blocks(part)
        own = {m: map_bound_px(camera, bound(m, blocks, 0.0)) for m in ('per_image', 'single')}
        for tracker in design.tracker_arcsec:
            best = bound('hierarchical', blocks, tracker)
            own['hierarchical'] = map_bound_px(camera, best)
            pointing = pointing_bound_arcsec(camera, best)
            ensemble = observe(part, tracker)
            for row, _ in _solutions(design, cell, ensemble, field, tracker):
                yield {
                    **row,
                    'own_bound_px': own[str(row['method'])],
                    'per_image_bound_px': own['per_image'],
                    'bound_px': own['hierarchical'],
                    'pointing_bound_arcsec': pointing,
                }


def _images_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """Increasing numbers of images of one field, tested on unused images."""
    most = max(design.images)
    field = draw_star_field(rng, most + UNUSED_IMAGES, max(design.stars))
    camera = field.truth.camera
    for cell, part in _cells(design, field):
        unused = field.part(most, UNUSED_IMAGES, part.outlier_draw.shape[1])
        floor = unused_residual_px(camera, unused)
        blocks = information_blocks(part)
        for tracker in design.tracker_arcsec:
            least = map_bound_px(camera, bound('hierarchical', blocks, tracker))
            ensemble = observe(part, tracker)
            for row, estimate in _solutions(design, cell, ensemble, field, tracker):
                yield {
                    **row,
                    'bound_px': least,
                    'unused_px': unused_residual_px(estimate.geometry.camera, unused),
                    'unused_true_px': floor,
                }


def _terms_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """One night as in the paper: stars drift through the field of a camera fixed to the Earth."""
    drawn = draw_scenario(rng)
    for images, tracker, method in itertools.product(
        design.images, design.tracker_arcsec, design.methods
    ):
        night = dataclasses.replace(
            drawn,
            image_count=images,
            cadence_s=NIGHT_S / (images - 1),
            star_tracker_sigma_arcsec=(tracker, tracker, tracker),
        )
        options = calibration_options(method, design.assumed(tracker), estimate=PARAMETER_NAMES)
        estimate = estimate_calibration(true_observations(night), night.prior, options)
        for step, removal in enumerate(removal_study(estimate)):
            std_u, std_v = removal.residual_std_px
            yield {
                'images': images,
                'tracker_arcsec': tracker,
                'method': method,
                'step': step,
                'removed': removal.removed,
                'wald': removal.wald,
                'residual_rms_px': removal.residual_rms_px,
                'residual_std_u_px': std_u,
                'residual_std_v_px': std_v,
                'map_change_px': removal.map_change_px,
            }


def _coverage_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """Errors in units of the reported sigma, with and without outliers."""
    field = draw_star_field(rng, max(design.images), max(design.stars))
    camera = field.truth.camera
    for cell, part in _cells(design, field):
        blocks = information_blocks(part)
        least = {
            tracker: map_bound_px(camera, bound('hierarchical', blocks, tracker))
            for tracker in design.tracker_arcsec
        }
        for tracker, share in itertools.product(design.tracker_arcsec, (0.0, OUTLIER_SHARE)):
            ensemble = observe(part, tracker, share)
            key: Row = {**cell, 'outlier_share': share}
            for row, estimate in _solutions(design, key, ensemble, field, tracker):
                sigma = np.sqrt(np.diag(estimate.covariance))[ESTIMATED]
                error = parameter_difference(estimate.geometry, field.truth)[ESTIMATED]
                names = estimate.geometry.camera.parameter_names + ALIGNMENT_NAMES
                yield {
                    **row,
                    'reported_px': map_bound_px(estimate.geometry.camera, estimate.map_covariance),
                    'bound_px': least[tracker],
                    'rejected': int((~estimate.kept).sum()),
                    **{
                        f'{names[k]}_sigmas': float(e / s)
                        for k, e, s in zip(ESTIMATED, error, sigma, strict=True)
                    },
                }


_TRIALS: Mapping[str, Callable[[Design, np.random.Generator], Iterable[Row]]] = {
    'table1': _table1_trial,
    'images': _images_trial,
    'terms': _terms_trial,
    'coverage': _coverage_trial,
}
