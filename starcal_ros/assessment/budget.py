# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Budget of the sigma of lines of sight by cause.

The part of a cause is the root of the variance that would be gone if it were known exactly, or
absent.  The covariance is ``C = L (1 + A) L'`` with L the root of the covariance under the working
weights (`posterior.ErrorParts`).

If some unknowns are known exactly, the covariance is that of the others conditioned on them:
``L T (1 + T' A T) T' L'`` with T an orthonormal basis of the null space of the rows of L of the
known unknowns.  If the shapes of the images are known, ``T = (1 + L' D L)^-1/2`` in the same
formula, where D is the information that unknown shapes take away.  If an error that observations
share is absent, A has no term of it and the weights stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import dataclasses
from dataclasses import dataclass
import itertools
import math

import numpy as np
from scipy.linalg import qr

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import common_rotation, Derivatives, grid_derivatives
from starcal_ros.camera import pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.amplitudes import LEAST_PX
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import equations
from starcal_ros.estimation.options import CalibrationOptions, tracker_sigma_is_given
from starcal_ros.estimation.posterior import common_shape, ErrorParts, TRACKER_NOISE, TRACKER_SLOW
from starcal_ros.estimation.unknowns import CHANGE, Layout, NO_OPTION, Option, UNKNOWNS
from starcal_ros.records import BUDGET_COLUMNS, BUDGET_ROWS, SigmaPart, Statement, TOTAL
from starcal_ros.text import significant

_WORTH_STATING = 0.9  # a fall of the sigma by less than a tenth is not worth a statement
_SHOWN = 3.0  # a slow error beyond three times the noise is in the images: no data sheet lowers it


def sigma_budget(
    estimate: Estimate, options: CalibrationOptions, has_alignment: bool = True
) -> tuple[SigmaPart, ...]:
    """
    Return the 1-sigma of lines of sight over the detector: the total, and by cause.

    Without an alignment no star tracker is a cause, and the pointing is that of the camera alone.
    """
    errors = estimate.posterior.errors
    assert errors is not None
    seen, of_pixel = _seen(estimate)
    in_root = seen.turned(errors.root)
    unresolved = of_pixel * estimate.map_covariance.unresolved_px**2
    rows = estimate.linear.layout.line_of_sight_at
    of_rows = seen.turned(np.eye(len(errors.root))[:, rows])
    covariance = estimate.map_covariance.matrix
    held = covariance - estimate.posterior.covariance[np.ix_(rows, rows)]
    shapes = _of_shapes(estimate, errors)
    changes = estimate.posterior.shapes
    common = common_shape(estimate.linear.layout, changes.common_px2)
    trends = _names_by_cause(estimate.linear.layout).get(CHANGE, [])
    of_change = _gain(errors, _known(errors, estimate, trends, shapes), in_root)
    change_px = float(np.linalg.norm(changes.sigma_px))
    parts = [
        _part('stars', _noise(estimate, errors, shapes, in_root), _of_stars(estimate)),
        *_of_unknowns(estimate, options, errors, in_root),
        _part(
            CHANGE,
            of_change + seen.variances(common),
            _estimated(change_px, changes.amplitudes.likelihood_ratio),
        ),
        *_of_errors(estimate, options, errors, in_root, unresolved),
        _part('held parameters', of_rows.variances(held), _of_held(estimate)),
    ]
    total = _part(TOTAL, of_rows.variances(covariance) + unresolved, '')
    parts = [total, *(part for part in parts if part.assumption)]
    if not has_alignment:
        parts = [
            dataclasses.replace(part, pointing_arcsec=part.map_arcsec)
            for part in parts
            if part.cause not in _causes_of_trackers()
        ]
    return tuple(parts)


def _part(cause: str, variance_rad2: Floats, assumption: str) -> SigmaPart:
    """
    Return a part of the budget by variances (k,).

    The mean over the detector of the map and of the pointing, then of the map at each pixel.
    """
    sigma_arcsec = np.sqrt(np.maximum(variance_rad2, 0.0)) / ARCSECOND_RAD
    of_map, of_pointing, *over_detector = sigma_arcsec.tolist()
    return SigmaPart(cause, of_map, of_pointing, assumption, tuple(over_detector))


def statements(
    parts: Sequence[SigmaPart],
    estimate: Estimate,
    options: CalibrationOptions,
    has_dates: bool = True,
) -> tuple[Statement, ...]:
    """
    Return what to state to lower the sigma of a budget, the largest fall first.

    The variance of a cause that the stars do not show is in proportion to that of its prior.
    ``has_dates`` is False where the images state no date: some statements need it.
    """
    total = next(part for part in parts if part.cause == TOTAL)
    has_alignment = any(part.cause in _causes_of_trackers() for part in parts)
    scopes = (('camera', 'map_arcsec'), ('pointing', 'pointing_arcsec'))[: 1 + has_alignment]
    rows = []
    for part in parts:
        if not max(part.map_arcsec, part.pointing_arcsec) > 0:
            continue
        option, value, left = _to_state(part.cause, estimate, options, has_dates)
        for scope, of in scopes if option else ():
            before, gone = getattr(total, of), getattr(part, of)
            after = math.sqrt(max(before**2 - (1.0 - left) * gone**2, 0.0))
            rows.append(Statement(option, value, scope, before, after, part.cause))
    by_option: dict[str, Statement] = {}
    for row in sorted(rows, key=lambda row: row.after_arcsec / max(row.before_arcsec, 1e-300)):
        if row.after_arcsec < _WORTH_STATING * row.before_arcsec:
            by_option.setdefault(row.option, row)
    return tuple(by_option.values())


def _causes_of_trackers() -> set[str]:
    """Return the causes that no calibration of the camera alone has."""
    of_unknowns = {kind.cause for kind in UNKNOWNS.values() if kind.of_tracker}
    return {TRACKER_NOISE, TRACKER_SLOW, *of_unknowns}


def _names_by_cause(layout: Layout) -> dict[str, list[str]]:
    """Return the names of the shared unknowns of each cause, in the order of their lines."""
    found: dict[str, list[str]] = {}
    for entry in sorted(layout.shared, key=lambda entry: entry.kind.line):
        if entry.kind.cause:
            found.setdefault(entry.kind.cause, []).append(entry.name)
    return found


def _to_state(
    cause: str, estimate: Estimate, options: CalibrationOptions, has_dates: bool
) -> Option:
    """Return an option that is not stated, with a plausible value, or `NO_OPTION`."""
    if cause == TRACKER_SLOW and not options.star_tracker_slow_arcsec:
        noise = options.star_tracker_sigma_arcsec
        if not tracker_sigma_is_given(options):
            noise = tuple(estimate.star_tracker_sigma_rad / ARCSECOND_RAD)
        if _slow(estimate) > _SHOWN * max(noise):
            return NO_OPTION  # the images contradict the plausible value
        slow = 0.5 * min(noise)
        return 'star_tracker_slow_arcsec', significant(slow, 2), (slow / _slow(estimate)) ** 2
    layout = estimate.linear.layout
    for name in _names_by_cause(layout).get(cause, []):
        kind = layout[name].kind
        option, value, left = kind.option(layout, options)
        if option and kind.needs_dates and not has_dates:
            option = f'{option} (and dates: the images have none)'
        if option:
            return option, value, left
    return NO_OPTION


@dataclass(frozen=True)
class _Seen:
    """
    Effect of r numbers on lines of sight: on the map and the pointing, and at pixels.

    ``means`` (2, r, r) are the means of ``J' J`` over the detector, ``J`` (n, 3, r) the
    derivatives of the map at the pixels of the budget.
    """

    means: Floats
    J: Floats

    def turned(self, root: Floats) -> _Seen:
        """Return the same by the columns of a root (r, s)."""
        return _Seen(np.asarray(root.T @ self.means @ root), self.J @ root)

    def variances(self, covariance: Floats) -> Floats:
        """Return the variances (2 + n,) under a symmetric covariance (r, r)."""
        over_detector = np.tensordot(self.means, covariance)
        flat = self.J.reshape(-1, len(covariance))
        at_pixels = ((flat @ covariance) * flat).sum(axis=1).reshape(self.J.shape[:2]).sum(axis=1)
        return np.concatenate([over_detector, at_pixels])


def _seen(estimate: Estimate) -> tuple[_Seen, Floats]:
    """Return the effect of the shared unknowns, and that (2 + n,) of a displaced pixel."""
    camera = estimate.geometry.camera
    means, of_pixel = mean_squares(estimate)
    found = Derivatives.at(camera, pixel_grid(camera, BUDGET_COLUMNS, BUDGET_ROWS))
    layout = estimate.linear.layout
    J = np.zeros((len(found.J), 3, layout.count))
    J[:, :, layout.line_of_sight_at] = np.nan_to_num(found.of_shape(camera))
    by_pixel = np.nan_to_num((found.by_pixel**2).sum(axis=(1, 2)))
    return _Seen(means, J), np.concatenate([[of_pixel, of_pixel], by_pixel])


def mean_squares(estimate: Estimate) -> tuple[Floats, float]:
    """
    Return the mean of ``J' J`` over the detector for map and pointing, (2, P, P).

    By the shared unknowns; with that of a displacement of the pixel along both axes.
    """
    camera, layout = estimate.geometry.camera, estimate.linear.layout
    grid = grid_derivatives(camera)
    common, seen = common_rotation(camera, grid), np.isfinite(grid.directions[:, 0])
    squares = np.zeros((2, layout.count, layout.count))
    rows = estimate.linear.layout.line_of_sight_at
    for k, J in enumerate((grid.of_shape(camera, common), grid.J)):
        flat = J[seen].reshape(-1, len(rows))
        squares[k][np.ix_(rows, rows)] = flat.T @ flat / np.count_nonzero(seen)
    return squares, float((grid.by_pixel[seen] ** 2).sum() / np.count_nonzero(seen))


def _gain(errors: ErrorParts, T: Floats, seen: _Seen) -> Floats:
    """Return the variances (k,) that the estimator of the root ``L T`` does not have."""
    inner = np.eye(T.shape[1]) + T.T @ errors.excess @ T
    return seen.variances(np.eye(len(T)) + errors.excess - T @ inner @ T.T)


def _known(
    errors: ErrorParts, estimate: Estimate, names: Sequence[str], shapes: Floats | None = None
) -> Floats:
    """
    Return T (r, s) of an estimator that is given some shared unknowns.

    With ``shapes`` (r, r), the information of `_of_shapes`, the shapes of the images too.
    """
    rows = errors.root[estimate.linear.layout.of(names)]
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = (rows / np.where(size > 0, size, 1.0))[size[:, 0] > 0]
    T: Floats = np.eye(rows.shape[1])
    if len(rows):
        # By pivoting, in a third of the time of singular values.
        T, R, _ = qr(rows.T, pivoting=True)
        size = np.abs(np.diag(R))
        T = T[:, np.count_nonzero(size > max(rows.shape) * np.finfo(float).eps * size.max()) :]
    if shapes is None:
        return T
    # The information of the shapes adds up within what is left.
    values, vectors = np.linalg.eigh(T.T @ shapes @ T)
    return np.asarray(T @ (vectors * (1.0 + values.clip(0.0)) ** -0.5) @ vectors.T)


def _of_shapes(estimate: Estimate, errors: ErrorParts) -> Floats:
    """Return the information (r, r) that the shapes of the images take from an estimate."""
    without = equations(estimate.sums, estimate.linear, LEAST_PX)
    given = estimate.posterior.equations
    return np.asarray(errors.root.T @ (without.information - given.information) @ errors.root)


def _noise(estimate: Estimate, errors: ErrorParts, shapes: Floats, seen: _Seen) -> Floats:
    """Return the variances (k,) by the noise of the centroids, all other causes absent."""
    names = itertools.chain(*_names_by_cause(estimate.linear.layout).values())
    T = _known(errors, estimate, list(names), shapes)
    noise = np.eye(T.shape[1]) + T.T @ (errors.excess - sum(errors.shared.values())) @ T
    return seen.variances(T @ noise @ T.T)


def _of_unknowns(
    estimate: Estimate, options: CalibrationOptions, errors: ErrorParts, seen: _Seen
) -> Iterator[SigmaPart]:
    """Yield the causes that are unknowns with a prior, or without one."""
    layout, found = estimate.linear.layout, estimate.posterior
    for cause, names in _names_by_cause(layout).items():
        if cause == CHANGE:
            continue
        entry = layout[names[0]]
        text = entry.kind.assumption(layout, found.mean, options)
        if entry is layout.field:
            text = _estimated(_field_px(estimate), found.field.likelihood_ratio)
        yield _part(cause, _gain(errors, _known(errors, estimate, names), seen), text)


def _of_errors(
    estimate: Estimate,
    options: CalibrationOptions,
    errors: ErrorParts,
    seen: _Seen,
    unresolved: Floats,
) -> Iterator[SigmaPart]:
    """Yield the causes that are errors which observations or attitudes share."""

    def absent(names: Iterable[str]) -> Floats:
        shared = [errors.shared[name] for name in names if name in errors.shared]
        return seen.variances(sum(shared, np.zeros_like(errors.excess)))

    for cause, of_star in (('star places', True), ('fine structure', False)):
        group = [error for error in estimate.weights.errors if error.of_star == of_star]
        if group:
            rms_px = math.sqrt(sum(error.variance_px2 for error in group))
            text = _estimated(rms_px, max(error.likelihood_ratio for error in group))
            variance = absent(error.name for error in group)
            yield _part(cause, variance if of_star else variance + unresolved, text)
    yield _part(TRACKER_NOISE, absent([TRACKER_NOISE]), _of_noise(estimate, options))
    yield _part(TRACKER_SLOW, absent([TRACKER_SLOW]), _of_slow(estimate, options))


def _estimated(rms_px: float, likelihood_ratio: float) -> str:
    ratio = max(likelihood_ratio, 0.0)
    size = f'{significant(rms_px, 2)} px rms per axis'
    return f'estimated, uncertainty included: {size}, 2 log L {ratio:.1f}'


def _field_px(estimate: Estimate) -> float:
    """Return the RMS of the field over the detector, its uncertainty included."""
    place = estimate.linear.layout.field_at
    square = estimate.posterior.mean[place] ** 2 + np.diag(estimate.posterior.covariance)[place]
    return math.sqrt(0.5 * float(square.sum()))


def _of_stars(estimate: Estimate) -> str:
    variance = estimate.weights.variance_px2[estimate.kept].mean()
    rms_px = significant(math.sqrt(variance), 2)
    return f'estimated: {rms_px} px rms of {int(estimate.kept.sum())} centroids'


def _of_noise(estimate: Estimate, options: CalibrationOptions) -> str:
    noise = ', '.join(
        f'{significant(s / ARCSECOND_RAD, 3)}' for s in estimate.star_tracker_sigma_rad
    )
    stated = ', '.join(significant(s, 3) for s in options.star_tracker_sigma_arcsec)
    given = f'{stated}″ stated; ' * tracker_sigma_is_given(options)
    return f'{given}estimated: {noise}″ about x, y, z'


def _of_slow(estimate: Estimate, options: CalibrationOptions) -> str:
    if not estimate.attitudes.trackers:
        return ''
    stated = options.star_tracker_slow_arcsec
    assumed = f'{significant(stated, 3)}″ stated' if stated else 'not given: as the noise assumed'
    ratio = max(one.likelihood_ratio for one in estimate.attitudes.trackers)
    slow = significant(_slow(estimate), 3)
    return f'{assumed}; estimated: {slow}″, 2 log L {max(ratio, 0.0):.1f}'


def _slow(estimate: Estimate) -> float:
    """Return the 1-sigma of the slow error of the star trackers, arcsec."""
    noise = estimate.star_tracker_sigma_rad / ARCSECOND_RAD
    trackers = estimate.attitudes.trackers
    return float(np.mean([t.slow / t.noise * noise[t.axes[0]] for t in trackers]))


def _of_held(estimate: Estimate) -> str:
    """Return the parameters that are held and have a sigma; empty if there are none."""
    problem = estimate.linear.problem
    held = np.setdiff1d(np.flatnonzero(np.isfinite(problem.prior_sigma)), problem.free)
    names = [
        f'{problem.parameter_names[k]} {significant(problem.prior_sigma[k], 3)}' for k in held
    ]
    return f'1-sigma of the prior: {", ".join(names)}' if names else ''
