"""
Monte Carlo studies of calibrations whose truth is known.

A study is a number of trials, each of which is drawn from its own (seed, study, trial) and knows
nothing of the others: whoever computes it, and in whatever order, gets the same rows.  Lengths are
pixels at the focal length (28 arcsec) unless a name says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import itertools
import json
import math
import zlib

import numpy as np
from scipy.stats import chi2

from starcal_ros.arrays import Floats
from starcal_ros.assessment.observability import map_error_px
from starcal_ros.assessment.term_removal import removal_study
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.calibrate import (
    Estimate,
    estimate_calibration,
)
from starcal_ros.records import CALIBRATION_PARAMETER_NAMES, CameraGeometry, Ensemble
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.studies.trials import (
    bound,
    calibration_options,
    draw_scenario,
    draw_star_field,
    errors,
    ESTIMATED,
    far_prior,
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
MANY_OUTLIERS = 0.1
SAME_SIGMAS = 0.01  # two answers nearer than this in every parameter are one minimum
UNUSED_IMAGES = 20
ENOUGH = 1.01  # residual of unused images, over that of the true camera, from which more is waste
NIGHT_S = 3590.0  # from the first image to the last (paper: 359 at ten seconds)
CONFIDENCE = 0.99
_MOST = 1000  # images, or stars of an image


@dataclass(frozen=True)
class Design:
    """
    What a study compares: all combinations of the lists are its cells.

    ``told_arcsec`` is the sigma of the star tracker that the calibration is told; None: the truth.
    """

    study: str
    trials: int
    images: tuple[int, ...]
    stars: tuple[int, ...]
    tracker_arcsec: tuple[float, ...]
    methods: tuple[str, ...]
    told_arcsec: float | None = None
    seed: int = 1

    def told(self, tracker_arcsec: float) -> float:
        """The sigma that the calibration is told of a star tracker."""
        return tracker_arcsec if self.told_arcsec is None else self.told_arcsec


_METHODS = ('per_image', 'single', 'hierarchical')  # in the order of the paper
STUDIES: Mapping[str, tuple[str, Design]] = {
    'table1': (
        'map error of the methods against star tracker noise (Table 1)',
        Design('table1', 200, (16,), (8, 80), (0.0, 5.0, 10.0, 20.0, 40.0, 60.0), _METHODS),
    ),
    'images': (
        'how many images are enough (Fig. 7)',
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
        'residual as terms are removed one at a time (Fig. 8)',
        Design('terms', 20, (15,), (), (20.0,), ('per_image',)),
    ),
    'coverage': (
        'whether errors are as large as the reported covariance says',
        Design('coverage', 200, (16,), (80,), (20.0,), ('per_image', 'hierarchical')),
    ),
    'start': (
        'whether a prior that is far off leads to the same minimum, with outliers too',
        Design('start', 100, (16,), (80,), (20.0,), _METHODS),
    ),
}
"""Name -> what it shows, and its design unless told otherwise."""


@dataclass(frozen=True)
class Campaign:
    """A study that was run: the rows of its trials, in order, and what they come to."""

    design: Design
    rows: tuple[Row, ...]
    summary: tuple[Row, ...]


def check(design: Design) -> None:
    """
    Raise `OptionError` that names what is wrong with a design.

    Raises
    ------
    OptionError
        A sentence for a person.
    """
    if design.study not in STUDIES:
        raise OptionError(f'study: {design.study!r} is not one of {", ".join(STUDIES)}')
    if not 1 <= design.trials <= 1_000_000:
        raise OptionError(f'--trials: {design.trials} is not within 1 to 1000000')
    if not 0 <= design.seed < 2**63:
        raise OptionError(f'--seed: {design.seed} is not within 0 to 2^63 - 1')
    for images in design.images:
        if not 2 <= images <= _MOST:
            raise OptionError(f'--images: {images} is not within 2 to {_MOST}')
    if design.study == 'terms' and design.stars:
        raise OptionError('--stars: the images of the study terms show the stars of the catalog')
    for stars in design.stars:
        if not 3 <= stars <= _MOST:
            raise OptionError(f'--stars: {stars} is not within 3 to {_MOST}')
    told = () if design.told_arcsec is None else (design.told_arcsec,)
    for sigma in (*design.tracker_arcsec, *told):
        if not 0 <= sigma <= 3600:
            raise OptionError(f'--tracker, --tracker-told: {sigma} is not within 0 to 3600')
    for method in design.methods:
        if method not in _METHODS:
            raise OptionError(f'--methods: {method!r} is not one of {", ".join(_METHODS)}')
    for name in ('images', 'stars', 'tracker_arcsec', 'methods'):
        values = getattr(design, name)
        if len(set(values)) < len(values):
            option = name.removesuffix('_arcsec')
            raise OptionError(f'--{option}: {" ".join(map(str, values))} says one thing twice')


def generator(design: Design, trial: int) -> np.random.Generator:
    """Random numbers of one trial."""
    return np.random.default_rng([design.seed, zlib.crc32(design.study.encode()), trial])


def run_trial(design: Design, trial: int) -> tuple[Row, ...]:
    """Rows of one trial: one for each cell, method and so on; none where nothing was solved."""
    rows = _TRIALS[design.study](design, generator(design, trial))
    return tuple({'trial': trial, **row} for row in rows)


def conclude(design: Design, rows: Iterable[Row]) -> Campaign:
    """
    The campaign of a design from the rows of all trials, whatever their order.

    Raises
    ------
    TooFewObservations
        When no calibration was possible in any cell.
    """
    ordered = tuple(sorted(rows, key=lambda row: row['trial']))
    if not ordered:
        raise TooFewObservations(
            f'none of the {design.trials} trials of {design.study} could be solved: '
            'more images or stars are needed'
        )
    return Campaign(design, ordered, tuple(_SUMMARIES[design.study](ordered)))


def content(campaign: Campaign, software: str) -> str:
    """JSON text of a campaign: every trial as columns, every line of the summary."""
    columns = list(dict.fromkeys(name for row in campaign.rows for name in row))
    parameters = dataclasses.asdict(campaign.design)
    lines = [
        f' {json.dumps(name)}: {json.dumps(value, allow_nan=False)}'
        for name, value in (
            ('software', software),
            ('study', parameters.pop('study')),
            ('seed', parameters.pop('seed')),
            ('parameters', parameters),
        )
    ]
    summary = [f'  {json.dumps(row, allow_nan=False)}' for row in campaign.summary]
    trials = [
        f'  {json.dumps(name)}: '
        + json.dumps([row.get(name) for row in campaign.rows], allow_nan=False)
        for name in columns
    ]
    lines.append(' "summary": [\n' + ',\n'.join(summary) + '\n ]')
    lines.append(' "trials": {\n' + ',\n'.join(trials) + '\n }')
    return '{\n' + ',\n'.join(lines) + '\n}\n'


def _cells(design: Design, field: StarField) -> Iterable[tuple[Row, StarField]]:
    """What tells a cell of images and stars from the others, and its part of a field."""
    for images, stars in itertools.product(design.images, design.stars):
        yield {'images': images, 'stars': stars}, field.part(0, images, stars)


def _solutions(
    design: Design, ensemble: Ensemble, field: StarField, tracker_arcsec: float
) -> Iterable[tuple[str, Estimate]]:
    """Each method with its estimate; not those whose images do not carry one."""
    for method in design.methods:
        options = calibration_options(method, design.told(tracker_arcsec))
        try:
            estimate = estimate_calibration(ensemble, field.prior, options)
        except TooFewObservations:
            continue
        yield method, estimate


def _score(estimate: Estimate, truth: CameraGeometry) -> Row:
    """How far off an estimate is, by itself and by the covariance that it reports."""
    return {
        'map_px': map_error_px(estimate.geometry.camera, truth.camera),
        'pointing_arcsec': pointing_error_arcsec(estimate.geometry, truth),
        'normalised': normalised_error_squared(estimate, truth),
        'converged': int(estimate.termination == 'converged'),
    }


def _table1_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """Each method at each star tracker noise, with the bounds of what it takes for true."""
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
            for method, estimate in _solutions(design, ensemble, field, tracker):
                yield {
                    **cell,
                    'tracker_arcsec': tracker,
                    'method': method,
                    **_score(estimate, field.truth),
                    'own_bound_px': own[method],
                    'per_image_bound_px': own['per_image'],
                    'bound_px': own['hierarchical'],
                    'pointing_bound_arcsec': pointing,
                }


def _images_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """The first few images, then more of the same, held against images that none has seen."""
    most = max(design.images)
    field = draw_star_field(rng, most + UNUSED_IMAGES, max(design.stars))
    camera = field.truth.camera
    for cell, part in _cells(design, field):
        unused = field.part(most, UNUSED_IMAGES, part.luck.shape[1])
        floor = unused_residual_px(camera, unused)
        blocks = information_blocks(part)
        for tracker in design.tracker_arcsec:
            least = map_bound_px(camera, bound('hierarchical', blocks, tracker))
            ensemble = observe(part, tracker)
            for method, estimate in _solutions(design, ensemble, field, tracker):
                yield {
                    **cell,
                    'tracker_arcsec': tracker,
                    'method': method,
                    **_score(estimate, field.truth),
                    'bound_px': least,
                    'unused_px': unused_residual_px(estimate.geometry.camera, unused),
                    'unused_true_px': floor,
                }


def _terms_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """One night like the paper's: its stars drift through a camera that stands on the Earth."""
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
        options = calibration_options(method, design.told(tracker), estimate=PARAMETER_NAMES)
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
    """Errors in units of the sigma reported, with and without outliers."""
    field = draw_star_field(rng, max(design.images), max(design.stars))
    camera = field.truth.camera
    for cell, part in _cells(design, field):
        blocks = information_blocks(part)
        for tracker, share in itertools.product(design.tracker_arcsec, (0.0, OUTLIER_SHARE)):
            least = map_bound_px(camera, bound('hierarchical', blocks, tracker))
            ensemble = observe(part, tracker, share)
            for method, estimate in _solutions(design, ensemble, field, tracker):
                sigma = np.sqrt(np.diag(estimate.covariance))[ESTIMATED]
                error = errors(estimate.geometry, field.truth)[ESTIMATED]
                yield {
                    **cell,
                    'tracker_arcsec': tracker,
                    'outlier_share': share,
                    'method': method,
                    **_score(estimate, field.truth),
                    'reported_px': map_bound_px(estimate.geometry.camera, estimate.covariance),
                    'bound_px': least,
                    'rejected': int((~estimate.kept).sum()),
                    **{
                        f'{CALIBRATION_PARAMETER_NAMES[k]}_sigmas': float(e / s)
                        for k, e, s in zip(ESTIMATED, error, sigma, strict=True)
                    },
                }


def _start_trial(design: Design, rng: np.random.Generator) -> Iterable[Row]:
    """All ten parameters from the truth and from a prior that is far off, of the same stars."""
    field = draw_star_field(rng, max(design.images), max(design.stars))
    far = far_prior(field.truth, rng)
    for cell, part in _cells(design, field):
        for tracker, share in itertools.product(design.tracker_arcsec, (0.0, MANY_OUTLIERS)):
            ensemble = observe(part, tracker, share)
            for method in design.methods:
                options = calibration_options(
                    method, design.told(tracker), estimate=PARAMETER_NAMES
                )
                near, away = (
                    estimate_calibration(ensemble, prior, options) for prior in (field.truth, far)
                )
                sigma = np.sqrt(np.diag(near.covariance))
                apart = np.abs(errors(away.geometry, near.geometry)) / sigma
                wild = (part.luck < share).ravel()
                yield {
                    **cell,
                    'tracker_arcsec': tracker,
                    'outlier_share': share,
                    'method': method,
                    'apart_sigmas': float(apart.max()),
                    'map_px': map_error_px(away.geometry.camera, field.truth.camera),
                    'outliers': int(wild.sum()),
                    'outliers_kept': int((away.kept & wild).sum()),
                    'iterations_near': near.iterations,
                    'iterations_far': away.iterations,
                }


def _groups(rows: Sequence[Row], *names: str) -> Iterable[tuple[Row, list[Row]]]:
    """Rows that agree in all the named columns, in the order in which they first appear."""
    groups: dict[tuple[int | float | str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    for key, members in groups.items():
        yield dict(zip(names, key, strict=True)), members


def column(rows: Sequence[Row], name: str) -> Floats:
    """A column of numbers of some rows."""
    return np.array([row[name] for row in rows], np.float64)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _relative_error_of_rms(values: Floats) -> float:
    """1-sigma of the RMS of a sample, relative to it."""
    squares = values**2
    if len(squares) < 2:
        return math.inf
    return float(0.5 * squares.std(ddof=1) / squares.mean() / math.sqrt(len(squares)))


def _ratio(rows: Sequence[Row], name: str, to: str) -> float:
    return _rms(column(rows, name)) / _rms(column(rows, to))


def _interval(parameters: int, trials: int) -> tuple[float, float]:
    """Where the mean of so many chi^2 lies with `CONFIDENCE`."""
    tail = (1 - CONFIDENCE) / 2
    low, high = chi2.ppf([tail, 1 - tail], parameters * trials) / trials
    return float(low), float(high)


def _common(rows: Sequence[Row]) -> Row:
    map_px = column(rows, 'map_px')
    return {
        'trials': len(rows),
        'map_px': _rms(map_px),
        'map_px_sigma': _sigma_or_zero(_rms(map_px) * _relative_error_of_rms(map_px)),
    }


def _sigma_or_zero(sigma: float) -> float:
    """A single trial has no scatter: JSON knows no infinity."""
    return sigma if math.isfinite(sigma) else 0.0


def _table1_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'method'):
        yield {
            **key,
            **_common(cell),
            'to_own_bound': _ratio(cell, 'map_px', 'own_bound_px'),
            'to_per_image_bound': _ratio(cell, 'map_px', 'per_image_bound_px'),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'pointing_arcsec': _rms(column(cell, 'pointing_arcsec')),
            'pointing_to_bound': _ratio(cell, 'pointing_arcsec', 'pointing_bound_arcsec'),
            'normalised': float(column(cell, 'normalised').mean()),
        }


def _images_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'method'):
        yield {
            **key,
            **_common(cell),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'unused_px': _rms(column(cell, 'unused_px')),
            'unused_to_true': _ratio(cell, 'unused_px', 'unused_true_px'),
        }


def _terms_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'tracker_arcsec', 'method', 'step'):
        removed = [str(row['removed']) for row in cell]
        usual = max(sorted(set(removed)), key=removed.count)
        yield {
            **key,
            'trials': len(cell),
            'usual': usual or 'none',
            'share': removed.count(usual) / len(cell),
            'residual_std_u_px': _rms(column(cell, 'residual_std_u_px')),
            'residual_std_v_px': _rms(column(cell, 'residual_std_v_px')),
            'map_change_px': _rms(column(cell, 'map_change_px')),
        }


def _coverage_summary(rows: Sequence[Row]) -> Iterable[Row]:
    names = [name for name in rows[0] if name.endswith('_sigmas')]
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'outlier_share', 'method'):
        low, high = _interval(len(ESTIMATED), len(cell))
        normalised = float(column(cell, 'normalised').mean())
        bias = {name: float(column(cell, name).mean()) for name in names}
        spread = {name: _rms(column(cell, name)) for name in names}
        worst = max(names, key=lambda name: abs(bias[name]))
        widest = max(names, key=lambda name: spread[name])
        yield {
            **key,
            **_common(cell),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'to_reported': _ratio(cell, 'map_px', 'reported_px'),
            'normalised': normalised,
            'low': low,
            'high': high,
            'inside': int(low <= normalised <= high),
            'worst_bias': worst.removesuffix('_sigmas'),
            'worst_bias_sigmas': bias[worst],
            'widest': widest.removesuffix('_sigmas'),
            'widest_rms_sigmas': spread[widest],
            **{f'bias_{name}': value for name, value in bias.items()},
            **{f'rms_{name}': value for name, value in spread.items()},
        }


def _start_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'outlier_share', 'method'):
        apart = column(cell, 'apart_sigmas')
        yield {
            **key,
            **_common(cell),
            'same_minimum': int((apart < SAME_SIGMAS).sum()),
            'worst_apart_sigmas': float(apart.max()),
            'outliers': int(column(cell, 'outliers').sum()),
            'outliers_kept': int(column(cell, 'outliers_kept').sum()),
            'iterations_near': float(column(cell, 'iterations_near').mean()),
            'iterations_far': float(column(cell, 'iterations_far').mean()),
        }


_TRIALS: Mapping[str, Callable[[Design, np.random.Generator], Iterable[Row]]] = {
    'table1': _table1_trial,
    'images': _images_trial,
    'terms': _terms_trial,
    'coverage': _coverage_trial,
    'start': _start_trial,
}
_SUMMARIES: Mapping[str, Callable[[Sequence[Row]], Iterable[Row]]] = {
    'table1': _table1_summary,
    'images': _images_summary,
    'terms': _terms_summary,
    'coverage': _coverage_summary,
    'start': _start_summary,
}


def table(campaign: Campaign) -> list[str]:
    """The summary as lines of aligned columns; bias and spread of single parameters left out."""
    names = [n for n in campaign.summary[0] if not n.startswith(('bias_', 'rms_'))]
    cells = [[_words(row[name]) for name in names] for row in campaign.summary]
    widths = [max(map(len, column)) for column in zip(names, *cells, strict=True)]
    return [
        '  '.join(f'{text:>{width}}' for text, width in zip(line, widths, strict=True))
        for line in [names, *cells]
    ]


def _words(value: int | float | str) -> str:
    return f'{value:.4g}' if isinstance(value, float) else str(value)
