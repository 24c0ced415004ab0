# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The next pointings of a campaign: where to point the camera so that a sigma falls fastest.

Near the estimate the posterior is linear: an image at a candidate pointing adds the rows of the
stars that the catalog has there, of its star-tracker attitude and of the prior of its shape, with
its own unknowns eliminated.  The image that lowers a variance most is chosen, then the next one
given it.  That needs no data, only where the stars are.

Amplitudes and variances stay those of the estimate, but for structure finer than the field that
the stars do not show: its bound falls as stars are added (`forecast`).  So a forecast draws
nothing at random, never rises with an image, and does not depend on the order of the images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import itertools
import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from starcal_ground.campaign import Campaign
from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.assessment.budget import mean_squares
from starcal_ros.assessment.gate import reasons_of
from starcal_ros.assessment.remedies import REMEDIES
from starcal_ros.assessment.requirements import (
    FOCAL,
    LINE_OF_SIGHT,
    MAP,
    POINTING,
    QUANTITIES,
    REQUIREMENTS,
    requirements_of,
)
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import Linearisation, star_rows, tracker_turns
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import Problem, State, whitened_attitude_errors
from starcal_ros.estimation.refraction import Refraction
from starcal_ros.estimation.search import problem_of, start_of
from starcal_ros.estimation.star_equations import arrange, star_table
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.estimation.unknowns import Assumptions, EntryInputs, IMAGE_ROTATION, unknowns_of
from starcal_ros.identification.prediction import predict
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import aligned_by, estimated
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import Ensemble, GateCheck, StarObservations
from starcal_ros.text import significant

_GROUPS = 20  # each group of neighbours in magnitude has a twentieth of the information
_ROUNDING = float(np.finfo(float).eps)  # held unknowns have no variance
_SHOWN = 4.0  # 2 log L of a variance that the stars show: two sigma
_AT_ONCE = 32  # candidates: their rows take some 10 MB
# A direction of which each candidate adds less than a thousandth of what is known does not count.
_LEAST_INFORMATION_GAIN = 1e-3


@dataclasses.dataclass(frozen=True)
class Target:
    """
    A sigma to lower: ``sqrt(tr(squares P) + constant) / unit``.

    ``squares`` (P, P) by the shared unknowns; ``name`` with the unit as suffix, and ``_rms`` if
    the requirement of that name is on the largest sigma.
    """

    name: str
    squares: Floats
    constant: float
    unit: float

    def sigma(self, covariance: Floats) -> float:
        """Return the 1-sigma under a covariance (P, P) of the shared unknowns."""
        variance = max(float(np.einsum('ij,ji->', self.squares, covariance)), 0.0)
        return math.sqrt(variance + self.constant) / self.unit


def target(estimate: Estimate, name: str) -> Target:
    """
    Return the sigma of a name of `QUANTITIES`, or of another unknown by its label.

    Sigmas over the detector, and that of both focal lengths, are RMS: ``line_of_sight`` is
    ``pointing`` then.

    Raises OptionError if nothing that is estimated has this name.
    """
    layout = estimate.linear.layout
    if name in (MAP, LINE_OF_SIGHT, POINTING):
        (of_map, of_pointing), of_pixel = mean_squares(estimate)
        unresolved = of_pixel * estimate.map_covariance.unresolved_px**2
        squares = of_map if name == MAP else of_pointing
        shown = name if name == POINTING else f'{name}_rms'
        return Target(f'{shown}_arcsec', squares, unresolved, ARCSECOND_RAD)
    labels = QUANTITIES[name].parameters if name in QUANTITIES else (name,)
    if not {*labels} <= {*layout.labels}:
        known = {LINE_OF_SIGHT, MAP, POINTING, FOCAL, *layout.labels}
        allowed = ', '.join(name for name in QUANTITIES if name in known)
        raise OptionError(f'{name!r} is not estimated; a sigma to lower is one of: {allowed}')
    of_name = np.isin(layout.labels, labels) / len(labels)
    unit = QUANTITIES[name].units[0] if name in QUANTITIES else ''
    scale = ARCSECOND_RAD if unit == 'arcsec' else 1.0
    shown = '_'.join(filter(None, [name, 'rms' * (len(labels) > 1), unit]))
    return Target(shown, np.diag(of_name), 0.0, scale)


def expected_noise_px2(estimate: Estimate, magnitude: Floats) -> Floats:
    """
    Return the variance (n,) per axis of centroids of stars of these magnitudes, as measured.

    From the observed stars in `_GROUPS` groups of neighbours in magnitude that have as much
    information each: bright stars are few and weigh most.
    """
    table = estimate.table
    order = np.argsort(table.magnitude)
    information = 1.0 / estimate.weights.variance_px2[order]
    share = np.cumsum(information) / information.sum()
    group = np.minimum((share * _GROUPS).astype(np.int64), _GROUPS - 1)
    count = np.bincount(group, minlength=_GROUPS)
    some = count > 0
    middle = np.bincount(group, table.magnitude[order], _GROUPS)[some] / count[some]
    mean = np.bincount(group, information, _GROUPS)[some] / count[some]
    return np.asarray(np.exp(-np.interp(magnitude, middle, np.log(mean))))


@dataclasses.dataclass(frozen=True)
class Prospect:
    """
    Information that c candidate images add to an estimate.

    ``root`` (P, r) of the covariance of the shared unknowns; ``information`` (c, q, q) of each
    image in its first q columns, the others are those that images hardly change: the covariance
    after images k, l is ``root (1 + information[k] + information[l])^-1 root'``.
    """

    root: Floats
    information: Floats

    def best(self, chosen: Sequence[int], allowed: Mask, squares: Floats) -> int:
        """
        Return which allowed candidate lowers a variance most, after those that are chosen.

        One that was chosen before comes back only if the others leave more than `_HELPS` of the
        sigma: a slow error of the star tracker may be the same in one attitude.
        """
        before = np.eye(self.information.shape[1]) + self.information[list(chosen)].sum(axis=0)
        shown, hidden = self._squares(squares)
        variance = np.full(len(self.information), np.inf)
        for k in np.flatnonzero(allowed):
            variance[k] = hidden + _variance(before + self.information[k], shown)
        variance[list(chosen)] *= (1.0 + _HELPS) ** 2
        return int(np.argmin(variance))

    def variances(self, chosen: Sequence[int], squares: Floats) -> Floats:
        """Return the variance (n + 1,) now and after each of n chosen candidates."""
        none = np.eye(self.information.shape[1])
        added = np.cumsum(self.information[list(chosen)], axis=0)
        shown, hidden = self._squares(squares)
        after = (none, *(none + one for one in added))
        return np.array([hidden + _variance(one, shown) for one in after])

    def _squares(self, squares: Floats) -> tuple[Floats, float]:
        """Squares (q, q) in the columns that images change, and the variance of the others."""
        changed, others = np.split(self.root, [self.information.shape[1]], axis=1)
        return changed.T @ squares @ changed, float(np.einsum('pr,pr', others, squares @ others))


def forecast(
    estimate: Estimate, wanted: Target, variances: Floats, stars: Sequence[int]
) -> Floats:
    """
    Return the sigma (n + 1,) to expect now and after each of n images.

    ``variances`` (n + 1,) are those of `Prospect.variances`, ``stars`` (n,) the stars of images.
    A variance of fine structure that the stars show stays; one that they do not is their bound on
    it, which falls as their number grows.
    """
    fine = [error for error in estimate.weights.errors if not error.of_star]
    hidden = sum(error.variance_px2 for error in fine if error.likelihood_ratio < _SHOWN)
    share = hidden / max(sum(error.variance_px2 for error in fine), 1e-300)
    added = np.concatenate([[0.0], np.cumsum(stars)])
    falls = 1.0 - share * added / (estimate.kept.sum() + added)
    return np.asarray(np.sqrt(variances.clip(0.0) + wanted.constant * falls) / wanted.unit)


def _variance(information: Floats, squares: Floats) -> float:
    return float(np.trace(cho_solve(cho_factor(information), squares)))


def prospect(
    estimate: Estimate, candidates: Sequence[StarObservations], options: CalibrationOptions
) -> Prospect:
    """
    Return what candidate images add.

    They hold the stars that an image would show, at the pixels of the calibrated camera, with the
    covariances to expect.  The velocity of the observer, the air, and the turn of a camera whose
    rate is not known act on them as on the images.
    """
    covariance = estimate.posterior.covariance
    size = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size).clip(1e-300))
    known = values > _ROUNDING * len(values)
    root = size[:, None] * vectors[:, known] * np.sqrt(values[known])
    parts = [candidates[k : k + _AT_ONCE] for k in range(0, len(candidates), _AT_ONCE)]
    total = np.zeros((len(root), len(root)))
    for part in parts:
        for _, place, rows in _rows(estimate, part, options):
            total[np.ix_(place, place)] += np.tensordot(rows, rows, ((0, 1), (0, 1)))
    root = root @ np.linalg.eigh(root.T @ total @ root)[1]
    told = np.zeros(root.shape[1])
    for part in parts:
        for _, place, rows in _rows(estimate, part, options):
            told = np.maximum(told, np.square(rows @ root[place]).sum(axis=1).max(axis=0))
    root = root[:, np.argsort(-told)]
    changed = root[:, : max(int(np.sum(told > _LEAST_INFORMATION_GAIN)), 1)]
    information = np.zeros((len(candidates), *changed.shape[1:] * 2))
    for k, part in enumerate(parts):
        for image, place, rows in _rows(estimate, part, options):
            seen = rows @ changed[place]
            information[k * _AT_ONCE + image] = seen.transpose(0, 2, 1) @ seen
    return Prospect(root, information)


def _rows(
    estimate: Estimate, candidates: Sequence[StarObservations], options: CalibrationOptions
) -> Iterator[tuple[Indices, list[int], Floats]]:
    """
    Yield equations of candidates in the shared unknowns: images (k,), places (u,), rows (k, n, u).

    The squares of rows are the information of an image, its own unknowns eliminated.
    """
    problem, state = _as_estimated(estimate, candidates, options)
    camera, known, count = estimate.geometry.camera, estimate.linear.layout, len(candidates)
    # The camera is at rest.  The sigmas are of no account: the estimate has the priors already.
    readout, stamps = (float(len(known.of([name])) > 1) for name in ('readout', 'stamps'))
    has_rates = not (readout or stamps)  # three turns stand for them where no image has a rate
    rates = Rates(
        np.full((count, 3), 0.0 if has_rates else np.nan), np.tile(np.eye(3), (count, 1, 1))
    )
    air = None
    if len(known.of(['site'])) == 2:  # latitude and one clock
        zenith = np.array([image.zenith_icrf for image in candidates])
        size_arcsec = float(candidates[0].refraction_arcsec[0])
        air = Refraction(np.zeros(count, np.int64), zenith, size_arcsec, 1.0)
    assumed = Assumptions(float('velocity' in known), (0.0, readout), stamps, air)
    size = camera.width, camera.height
    layout = unknowns_of(EntryInputs(problem, state, rates, size, assumed))
    place = [known.labels.index(label) for label in layout.labels]
    table = star_table(candidates)
    measurements = arrange(table, np.ones(len(table), bool), table.covariance_px2)
    linear = Linearisation(problem, state, layout, measurements, table.measured_px)
    _, J = whitened_attitude_errors(problem, state)
    turning, turns = tracker_turns(layout)
    whole = np.arange(layout.count), np.zeros(layout.count)
    for chunk, by_shared, by_own, _ in star_rows(linear, *whole):
        _, stars, b = by_own.shape
        # The star tracker and the prior of the shape add rows.
        shared = np.pad(by_shared, ((0, 0), (0, b), (0, 0)))
        own = np.pad(by_own, ((0, 0), (0, b), (0, 0)))
        of_tracker, of_shape = np.split(np.arange(stars, stars + b), [IMAGE_ROTATION.stop])
        shared[:, of_tracker[:, None], turning] = -J[chunk.image] @ turns[chunk.image]
        own[:, of_tracker, IMAGE_ROTATION] = J[chunk.image]
        own[:, of_shape, layout.shape_at] = np.diag(1.0 / estimate.posterior.shapes.sigma_px)
        Q = np.linalg.qr(own)[0]
        yield chunk.image, place, shared - Q @ (Q.transpose(0, 2, 1) @ shared)


def _as_estimated(
    estimate: Estimate, candidates: Sequence[StarObservations], options: CalibrationOptions
) -> tuple[Problem, State]:
    """Return problem and state of candidates: the camera, and star trackers as the images have."""
    problem = problem_of(Ensemble(tuple(candidates)), estimate.geometry, options)
    sigma_rad = np.median(estimate.linear.problem.star_tracker_sigma_rad, axis=0)
    problem = dataclasses.replace(
        problem, star_tracker_sigma_rad=np.tile(sigma_rad, (len(candidates), 1))
    )
    estimated = estimate.linear.state
    state = start_of(problem, estimate.geometry, len(estimated.focal), bool(len(estimated.rate)))
    return problem, dataclasses.replace(state, focal=estimated.focal, rate=estimated.rate)


_CANDIDATES = 150  # in a cone: on the whole sky 16 degrees apart
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_FAINTEST = 0.99  # share of the stars observed so far that are brighter than those predicted
_HELPS = 0.01  # an image that lowers the sigma by less has ceased to help
_SAME_COSINE = 1e-12  # rounding: a pointing can be reached from itself


def _direction(ra_deg: float, dec_deg: float) -> Floats:
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


@dataclasses.dataclass(frozen=True)
class Pointing:
    """+z of the camera to (ra, dec), ICRF; +x towards east, then turned about +z by the roll."""

    ra_deg: float
    dec_deg: float
    roll_deg: float = 0.0

    @property
    def icrf_from_camera(self) -> Rotation:
        """Attitude of the camera."""
        ra, dec, roll = np.radians([self.ra_deg, self.dec_deg, self.roll_deg])
        return Rotation.from_euler('ZXZ', [ra + np.pi / 2, np.pi / 2 - dec, roll])


@dataclasses.dataclass(frozen=True)
class Cone:
    """Directions within a radius of a direction, ICRF."""

    ra_deg: float
    dec_deg: float
    radius_deg: float


@dataclasses.dataclass(frozen=True)
class PlanRequest:
    """
    Wishes and bounds of a plan.

    ``minimise`` is the name of a requirement, see `target`.  ``pointings`` are allowed, each at
    most once; empty: any of ``within``.  No boresight comes into ``avoid``, as the Sun, the Moon
    and the Earth.  A slew is between the boresights of one image and the next.
    """

    images: int
    minimise: str = LINE_OF_SIGHT
    pointings: tuple[Pointing, ...] = ()
    within: Cone = Cone(0.0, 0.0, 180.0)
    avoid: tuple[Cone, ...] = ()
    largest_slew_deg: float = 180.0

    def __post_init__(self) -> None:
        """Raise OptionError for numbers that have no meaning."""
        limits = {'dec_deg': (-90.0, 90.0), 'radius_deg': (0.0, 180.0)}
        given: dict[str, tuple[Pointing | Cone, ...]]
        given = {'pointings': self.pointings, 'avoid': self.avoid, 'within': (self.within,)}
        for option, places in given.items():
            for name, value in itertools.chain(*(vars(place).items() for place in places)):
                low, high = limits.get(name, (-360.0, 360.0))
                if not low <= value <= high:  # NaN is within nothing
                    raise OptionError(
                        f'--{option}: {name} is {value:g}, not within {low:g} to {high:g}'
                    )


@dataclasses.dataclass(frozen=True)
class Step:
    """An image to take: its pointing, the stars to expect, and the sigma to expect after it."""

    pointing: Pointing
    stars: int
    sigma: float


@dataclasses.dataclass(frozen=True)
class Plan:
    """
    The images to take, in order.

    ``name`` is that of the `Target`, ``sigma`` its value now, and ``enough`` the number of images
    after which the next one lowers it by less than 1 %; None: not reached.
    """

    name: str
    sigma: float
    steps: tuple[Step, ...]
    enough: int | None


@one_blas_thread()
def plan_pointings(ensemble: Ensemble, setup: Setup, request: PlanRequest) -> Plan:
    """
    Return the pointings that lower a sigma most, each given those before it.

    Raises TooFewObservations when the ensemble so far gives no estimate to start from. Raises
    OptionError for a sigma that is not estimated, or if no pointing is allowed or shows a star.
    """
    setup = aligned_by(ensemble, setup)
    estimate = estimated(ensemble, setup)
    wanted = target(estimate, request.minimise)
    pointings = _allowed(request)
    images = [_expected(estimate, ensemble, setup, one) for one in pointings]
    if not any(map(len, images)):
        raise OptionError('no pointing that is allowed shows a star')
    each = prospect(estimate, images, setup.calibration)
    chosen = _chosen(each, wanted, request, pointings, np.array([len(i) > 0 for i in images]))
    stars = [len(images[k]) for k in chosen]
    sigmas = forecast(estimate, wanted, each.variances(chosen, wanted.squares), stars)
    few = np.flatnonzero(sigmas[1:] > (1.0 - _HELPS) * sigmas[:-1])
    enough = int(few[0]) if len(few) else None
    now, *after = sigmas.tolist()
    chosen_pointings = [pointings[k] for k in chosen]
    return Plan(wanted.name, now, tuple(map(Step, chosen_pointings, stars, after)), enough)


def _chosen(
    each: Prospect, wanted: Target, request: PlanRequest, pointings: Sequence[Pointing], free: Mask
) -> list[int]:
    """Return the numbers of the pointings to take; ``free`` (c,) show stars."""
    boresights = np.array([_direction(one.ra_deg, one.dec_deg) for one in pointings])
    least = math.cos(math.radians(request.largest_slew_deg)) - _SAME_COSINE
    chosen: list[int] = []
    allowed = free
    while len(chosen) < request.images and allowed.any():
        chosen.append(each.best(chosen, allowed, wanted.squares))
        if request.pointings:  # a camera may return to a direction of a cone, not to an image
            free = free & (np.arange(len(free)) != chosen[-1])
        allowed = free & (boresights @ boresights[chosen[-1]] >= least)
    return chosen


def _allowed(request: PlanRequest) -> list[Pointing]:
    """Return the allowed pointings: of the list, or evenly over the cone, each with a roll."""
    allowed = list(request.pointings) or _over(request.within)
    boresights = np.array([_direction(one.ra_deg, one.dec_deg) for one in allowed])
    clear = np.ones(len(allowed), bool)
    for cone in request.avoid:
        cosine = boresights @ _direction(cone.ra_deg, cone.dec_deg)
        clear &= cosine <= math.cos(math.radians(cone.radius_deg))
    return [one for one, is_clear in zip(allowed, clear, strict=True) if is_clear]


def _over(cone: Cone) -> list[Pointing]:
    """Return pointings on a spiral of the golden section."""
    k = np.arange(_CANDIDATES) + 0.5
    from_axis = np.arccos(1.0 - (1.0 - math.cos(math.radians(cone.radius_deg))) * k / _CANDIDATES)
    about = 2.0 * np.pi * _GOLDEN * k
    to_icrf = Pointing(cone.ra_deg, cone.dec_deg).icrf_from_camera
    spiral = np.stack([np.cos(about), np.sin(about)]) * np.sin(from_axis)
    x, y, z = to_icrf.apply(np.stack([*spiral, np.cos(from_axis)], axis=-1)).T
    ra_deg, dec_deg = np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arcsin(z.clip(-1, 1)))
    roll_deg = 360.0 * (k * math.sqrt(2.0) % 1.0)
    return [Pointing(*row) for row in np.stack([ra_deg, dec_deg, roll_deg], axis=-1).tolist()]


def _expected(
    estimate: Estimate, ensemble: Ensemble, setup: Setup, pointing: Pointing
) -> StarObservations:
    """Return what an image is expected to show: stars as bright as those observed so far."""
    geometry, last = estimate.geometry, ensemble.images[-1]
    star_tracker = pointing.icrf_from_camera * geometry.star_tracker_from_camera.inv()
    camera = geometry.camera
    stars = predict(
        geometry,
        star_tracker.as_quat(),
        last.time_ns,
        setup.catalog,
        float(np.quantile(estimate.table.magnitude, _FAINTEST)),
        0.0,
        site=setup.site,
    )
    magnitude = setup.catalog.magnitude[stars.catalog_index]
    variance = expected_noise_px2(estimate, magnitude)
    zero = np.zeros(len(magnitude))
    unknown = np.full(len(magnitude), np.nan, np.float32)
    return StarObservations.of_image(
        last.time_ns,
        (camera.width, camera.height),
        icrf_from_star_tracker_xyzw=star_tracker.as_quat(),
        catalog_id=setup.catalog.id[stars.catalog_index],
        direction_icrf=stars.direction_icrf,
        magnitude=magnitude.astype(np.float32),
        measured_px=stars.xy_px,
        covariance_px2=np.stack([variance, zero, variance], axis=-1),
        flux_dn=unknown,
        snr=unknown,
        velocity_sigma_m_s=last.velocity_sigma_m_s,
        zenith_icrf=last.zenith_icrf,
        refraction_arcsec=last.refraction_arcsec,
        temperature_degc=last.temperature_degc,
        # A camera at rest, where the rates of the images are known.
        star_tracker_rate_rad_s=0.0 * last.star_tracker_rate_rad_s,
    )


_MOST_IMAGES = 20  # that reach a requirement


def with_images_to_reach(campaign: Campaign) -> Campaign:
    """
    A campaign whose missed requirements have the next images in the note of their check.

    The sigma that a plan lowers is an RMS: a requirement over a share falls in proportion.
    """
    wanted = iter(requirements_of(campaign.setup.gate.requirements))
    checks = tuple(
        _planned(campaign, next(wanted).name, one) if one.option == REQUIREMENTS else one
        for one in campaign.calibration.gate
    )
    if checks == campaign.calibration.gate:
        return campaign
    reasons = reasons_of(checks)
    calibration = dataclasses.replace(campaign.calibration, gate=checks, reasons=reasons)
    return dataclasses.replace(campaign, calibration=calibration)


def _planned(campaign: Campaign, minimise: str, check: GateCheck) -> GateCheck:
    if not check.found > check.limit:
        return check
    try:
        request = PlanRequest(_MOST_IMAGES, minimise)
        plan = plan_pointings(campaign.ensemble, campaign.setup, request)
    except (StarcalError, np.linalg.LinAlgError):  # not estimated, or no image shows a star
        return check
    scale = check.found / plan.sigma
    enough = [k for k, step in enumerate(plan.steps, 1) if scale * step.sigma <= check.limit]
    if not enough:
        if not check.note.endswith(REMEDIES['stars']):
            return check  # its remedy is another
        last = significant(scale * plan.steps[-1].sigma, 2)
        unit = check.unit and f' {check.unit}'
        words = f'{len(plan.steps)} more images reach {last}{unit}, not enough'
    else:
        place = plan.steps[0].pointing
        words = f'{enough[0]} more images reach it (starcal plan)'
        if enough[0] == 1:
            at = f'RA {place.ra_deg:.1f}, Dec {place.dec_deg:+.1f}, roll {place.roll_deg:.0f}'
            words = f'1 more image reaches it, at {at} degrees'
    return dataclasses.replace(check, note=f'{check.note.partition("; ")[0]}; {words}')
