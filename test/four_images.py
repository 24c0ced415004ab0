# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Four images of twenty stars with every unknown, and the dense problem by an independent projection.

The dense matrices come from finite differences of pixels and star-tracker errors as functions of
all unknowns, written here from their definitions.
"""

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import functools

import erfa
import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.equations import Linearisation, star_sums, StarSums
from starcal_ros.estimation.problem import Problem, State
from starcal_ros.estimation.star_equations import arrange, Measurements, StarTable
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.estimation.unknowns import Assumptions, EntryInputs, Layout, unknowns_of

WIDTH, HEIGHT = 1200, 800
IMAGES, STARS = 4, 20
LIGHT_M_S = 299792458.0
SIGMA = {'velocity': 8000.0, 'colour': 3e-4, 'readout': 0.02, 'stamps': 0.005}
ASSUMED = Assumptions(velocity_m_s=8000.0, readout_s=(0.004, 0.02), stamp_s=0.005)
# Images see 10 of 14 degrees; distortion moves the corners by 8 px.
CAMERA = CameraModel(
    WIDTH, HEIGHT, np.r_[5000.0, 1.5, 5010.0, 603.0, 396.0, -0.3, 0.5, 0.0, 4e-4, -3e-4]
)
HELD = ('skew', 'k3')
OWN = 11  # unknowns of an image: its rotation, its shape, the error of its rate
TURN_S = 0.02  # rms time of read-out
COLOUR = np.random.default_rng(2000).normal(size=IMAGES * STARS)  # from the mean, mag
SHAPE = np.array([0.2, 0.3, 0.4, 0.5, 0.6])
# 1-sigma of one image's scale, stretch, shear and decentring, px


@dataclass(frozen=True)
class Small:
    """A small ensemble at a state, with its list of unknowns."""

    problem: Problem
    state: State
    table: StarTable
    rates: Rates
    layout: Layout
    keep: Mask  # (n,) of stars that are used: images have 20, 18, 16 and 13

    @property
    def predicted_px(self) -> Floats:
        """Pixels (n, 2) by the camera and the rotations of the state."""
        zero = np.zeros((IMAGES, OWN))
        return self.pixels(np.zeros(self.layout.count), zero, with_field=False)

    def measurements(self) -> Measurements:
        """Stars that are used, weighted by their covariances."""
        return arrange(self.table, self.keep, self.table.covariance_px2)

    def linear(self) -> Linearisation:
        measurements = self.measurements()
        return Linearisation(
            self.problem, self.state, self.layout, measurements, self.predicted_px
        )

    def sums(self) -> StarSums:
        return star_sums(self.linear())

    def named(self, x: Floats) -> dict[str, Floats]:
        """Shared unknowns by the name of their entry."""
        return {entry.name: x[self.layout.places[entry.name]] for entry in self.layout.shared}

    def pixels(self, x: Floats, y: Floats, with_field: bool = True) -> Floats:
        """Predicted pixels (n, 2) at shared unknowns (P,) and those of the images (m, 11)."""
        value, state = self.named(x), self.state
        result = np.empty((len(self.table), 2))
        parameters = state.parameters + value['camera']
        focal = state.focal + value.get('focal', np.zeros(0))
        for k in range(IMAGES):
            here = self.table.image == k
            above_k = self.problem.above_reference_k[k]
            own = parameters.copy()
            own[:3] *= 1.0 + sum(a * above_k ** (i + 1) for i, a in enumerate(focal))
            scale, stretch, shear, *decentring_px = y[k, 3:8]
            own[0] += scale + stretch
            own[1] += shear
            own[2] += scale - stretch
            # p1 and p2 of a px where the radius is half of the diagonal.
            half_px = 0.5 * np.hypot(WIDTH, HEIGHT)
            own[8:] += np.array(decentring_px) * state.parameters[0] / half_px**2
            e = self.table.direction_icrf[here]
            if 'velocity' in value:
                beta = value['velocity'] / LIGHT_M_S
                e = erfa.ab(e, beta, np.inf, np.sqrt(1.0 - beta @ beta))
            e = state.camera_from_icrf[k].apply(e)
            if 'colour' in value:  # a longer focal length for red stars
                scale = 1.0 + value['colour'] * COLOUR[here]
                e = e * np.column_stack([scale, scale, np.ones(len(e))])
            if value.get('readout', np.zeros(1))[0] or y[k, 8:].any():
                # The camera turns by its rate from the middle row's time to that of the row.
                rows = (self.predicted_px[here, 1] - (HEIGHT - 1) / 2.0) / HEIGHT
                turn = value.get('readout', np.zeros(1))[0] * self.rates.rad_s[k]
                turn = turn + TURN_S * self.rates.root_rad_s[k] @ y[k, 8:]
                e = Rotation.from_rotvec(-rows[:, None] * turn).apply(e)
            e = Rotation.from_rotvec(-y[k, :3]).apply(e)
            result[here] = project(dataclasses.replace(CAMERA, parameters=own), e)
        if with_field:
            result += self.field_px(value['field'])
        return result

    def field_px(self, coefficients: Floats) -> Floats:
        """Displacements (n, 2) by the field, its terms by their labels."""
        u, v = self.predicted_px.T
        moved = np.zeros((len(u), 2))
        for label, value in zip(self.layout['field'].labels, coefficients, strict=True):
            if value:
                _, i, j, axis, _ = label.split('_')
                term = cosine(u, int(i), WIDTH) * cosine(v, int(j), HEIGHT)
                moved[:, 'uv'.index(axis)] += value * term
        return moved

    def tracker_errors(self, x: Floats, y: Floats) -> Floats:
        """Errors (m, 3) of the star trackers, rad, in their frames."""
        value, problem, state = self.named(x), self.problem, self.state
        rate = state.rate + value.get('rate', np.zeros(len(state.rate)))
        mountings = state.mountings + value.get('mountings', np.zeros(len(state.mountings)))
        errors = []
        for k in range(IMAGES):
            alignment = Rotation.from_rotvec(-value['alignment']) * state.camera_from_star_tracker
            if len(rate):
                turned = Rotation.from_rotvec(-problem.above_reference_k[k] * rate)
                alignment = turned * alignment
            if problem.first_from_star_tracker is not None:
                if problem.star_tracker[k]:
                    alignment = Rotation.from_rotvec(-mountings) * alignment
                alignment = alignment * problem.first_from_star_tracker[k]
            if 'stamps' in value:
                late = Rotation.from_rotvec(-value['stamps'][0] * self.rates.rad_s[k])
                alignment = late * alignment
            camera = Rotation.from_rotvec(-y[k, :3]) * state.camera_from_icrf[k]
            predicted = alignment * problem.star_tracker_from_icrf[k]
            # By how much the reported attitude is turned against the true one.
            in_tracker = alignment.inv() * (predicted * camera.inv()) * alignment
            errors.append(in_tracker.as_rotvec())
        return np.array(errors)


def cosine(pixel: Floats, half_waves: int, size: int) -> Floats:
    """Cosine of a mean square of one over a domain a third longer than the detector."""
    first, length = -0.5 - 0.175 * size, 1.35 * size
    values = np.cos(np.pi * half_waves * (pixel - first) / length)
    return np.asarray(values * np.sqrt(2.0) if half_waves else values)


def small(
    seed: int = 1,
    *,
    terms: bool = True,
    two_trackers: bool = True,
    shapes_px: Floats | None = None,
    field_px: float = 0.0,
) -> Small:
    """Return the ensemble: with terms of temperature, two star trackers, and every assumption."""
    rng = np.random.default_rng(seed)
    camera_from_icrf = Rotation.random(IMAGES, random_state=rng)
    image = np.repeat(np.arange(IMAGES), STARS)
    pixels = rng.uniform([0.0, 0.0], [WIDTH - 1.0, HEIGHT - 1.0], (IMAGES * STARS, 2))
    in_camera = line_of_sight(CAMERA, pixels)
    direction = np.concatenate(
        [camera_from_icrf[k].inv().apply(in_camera[image == k]) for k in range(IMAGES)]
    )
    variance = rng.uniform(0.05, 0.3, (len(image), 2)) ** 2
    correlation = rng.uniform(-0.6, 0.6, len(image))
    covariance = np.stack(
        [variance[:, 0], correlation * np.sqrt(variance.prod(axis=1)), variance[:, 1]], axis=1
    )
    measured = pixels + 0.2 * rng.normal(size=pixels.shape)
    alignment = Rotation.random(random_state=rng)
    mounted = Rotation.random(random_state=rng)
    number = np.array([0, 1, 0, 1]) if two_trackers else np.zeros(IMAGES, int)
    mountings = Rotation.concatenate([mounted if k else Rotation.identity() for k in number])
    frame = alignment * mountings if two_trackers else alignment
    error = Rotation.from_rotvec(15.0 * ARCSECOND_RAD * rng.normal(size=(IMAGES, 3)))
    names = CAMERA.parameter_names
    sigma = np.full(len(names), np.inf)
    sigma[[names.index('cx'), names.index('cy')]] = 20.0
    sigma[names.index('k1')] = 0.02
    problem = Problem(
        method='hierarchical',
        model='plumb_bob',
        free=np.array([k for k, name in enumerate(names) if name not in HELD]),
        prior_parameters=CAMERA.parameters + rng.normal(size=len(names)) * 1e-3,
        prior_sigma=sigma,
        star_tracker_from_icrf=error * frame.inv() * camera_from_icrf,
        star_tracker_sigma_rad=np.tile(np.array([8.0, 10.0, 25.0]) * ARCSECOND_RAD, (IMAGES, 1)),
        above_reference_k=np.array([-8.0, -1.0, 3.0, 7.0]),
        star_tracker=number,
        first_from_star_tracker=mountings if two_trackers else None,
        mounting_sigma_rad=60.0 * ARCSECOND_RAD,
    )
    state = State(
        CAMERA.parameters.copy(),
        alignment,
        Rotation.from_rotvec(5.0 * ARCSECOND_RAD * rng.normal(size=(IMAGES, 3)))
        * camera_from_icrf,
        np.array([2e-6, -1e-7]) if terms else np.zeros(0),
        np.array([1e-6, -2e-6, 3e-6]) if terms else np.zeros(0),
        mountings=np.array([2e-5, -1e-5, 3e-5]) if two_trackers else np.zeros(0),
    )
    rates = np.radians(0.1) * rng.normal(size=(IMAGES, 3))
    of_rates = np.random.default_rng(seed + 1000)  # errors of 10 arcsec within an image
    root = 2e-3 * of_rates.uniform(-1.0, 1.0, (IMAGES, 3, 3))
    given_rates = Rates(rates, root, TURN_S)
    star = np.arange(len(image)) % 50
    table = StarTable(
        image,
        star + 100,
        star,
        direction,
        rng.uniform(2.0, 8.0, len(image)).astype(np.float32),
        measured,
        covariance,
        IMAGES,
    )
    assumed = dataclasses.replace(ASSUMED, colour=COLOUR)
    layout = unknowns_of(EntryInputs(problem, state, given_rates, (WIDTH, HEIGHT), assumed))
    keep = np.arange(len(image)) % STARS < np.array([20, 18, 16, 13])[image]
    made = Small(problem, state, table, given_rates, layout, keep)
    if shapes_px is None and not field_px:
        return made
    own = np.zeros((IMAGES, OWN))
    own[:, 3:8] = 0.0 if shapes_px is None else shapes_px
    moved = made.pixels(np.zeros(layout.count), own, with_field=False) - made.predicted_px
    moved += made.field_px(field_px * rng.normal(size=len(layout['field'])) / octave_size(made))
    table = dataclasses.replace(table, measured_px=table.measured_px + moved)
    return dataclasses.replace(made, table=table)


# Steps that move pixels by about a tenth: differences of the fourth order are exact to 1e-11
# there, and the rounding of pixels is 1e-12 of such a step.
_STEPS = {
    'camera': np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1e-2, 1e-1, 1.0, 1e-3, 1e-3]),
    'focal': np.array([1e-5, 1e-6]),
    'velocity': 8000.0,
    'colour': 1e-4,
    'readout': 0.02,
    'stamps': 0.005,
    'field': 0.1,
    'alignment': 1e-4,
    'rate': 1e-5,
    'mountings': 1e-4,
}
IMAGE_STEPS = np.array([1e-4, 1e-4, 1e-4, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])


def shared_steps(given: Small) -> Floats:
    """Steps (P,) of finite differences."""
    return np.concatenate([np.full(len(e), _STEPS[e.name]) for e in given.layout.shared])


def difference(function: Callable[[float], Floats], step: float) -> Floats:
    """Derivative at zero by differences of the fourth order."""
    near = function(step) - function(-step)
    far = function(2.0 * step) - function(-2.0 * step)
    return np.asarray((8.0 * near - far) / (12.0 * step))


@dataclass(frozen=True)
class Dense:
    """
    The whole problem without any elimination.

    ``stars`` (2 n, P + 11 m) and ``trackers`` (3 m, P + 11 m) are whitened derivatives of the
    predicted pixels, zero for stars that are not used, and of the star-tracker errors;
    ``residual`` (2 n,), ``error`` (3 m,).
    """

    stars: Floats
    residual: Floats
    trackers: Floats
    error: Floats


def dense(given: Small) -> Dense:
    """Return the derivatives of a small ensemble by finite differences."""
    P, field = given.layout.count, given.layout.places['field']
    white = whitener(given.table.covariance_px2)
    white *= np.repeat(given.keep, 2)[:, None]
    steps = np.concatenate([shared_steps(given), np.tile(IMAGE_STEPS, IMAGES)])
    stars: list[Floats] = []
    trackers: list[Floats] = []
    for k, step in enumerate(steps):
        if field.start <= k < field.stop:  # linear, and of the pixels alone
            stars.append(given.field_px(np.eye(field.stop - field.start)[k - field.start]).ravel())
            trackers.append(np.zeros(3 * IMAGES))
            continue

        def unknowns(size: float, k: int = k) -> tuple[Floats, Floats]:
            z = np.zeros(len(steps))
            z[k] = size
            return z[:P], z[P:].reshape(IMAGES, OWN)

        def pixels(size: float) -> Floats:
            return given.pixels(*unknowns(size)).ravel()

        def errors(size: float) -> Floats:
            return given.tracker_errors(*unknowns(size)).ravel()

        stars.append(difference(pixels, step))
        trackers.append(difference(errors, step))
    residual = (given.table.measured_px - given.predicted_px).ravel()
    sigma = given.problem.star_tracker_sigma_rad.ravel()
    zero = np.zeros(P), np.zeros((IMAGES, OWN))
    return Dense(
        white @ np.array(stars).T,
        white @ residual,
        np.array(trackers).T / sigma[:, None],
        given.tracker_errors(*zero).ravel() / sigma,
    )


@functools.cache
def usual() -> tuple[Small, Dense]:
    given = small()
    return given, dense(given)


def whitener(covariance_px2: Floats) -> Floats:
    """Matrix (2 n, 2 n) that whitens residuals: inverse Cholesky factors."""
    parts = [np.array([[uu, uv], [uv, vv]]) for uu, uv, vv in covariance_px2]
    return np.asarray(block_diag(*(np.linalg.inv(np.linalg.cholesky(one)) for one in parts)))


def prior_precision(given: Small, shape_px: Floats, field_px: Floats | None) -> Floats:
    """Prior precision (P + 11 m,), infinite if held; ``field_px`` (3,) by octave, None: held."""
    parts = []
    problem = given.problem
    for entry in given.layout.shared:
        precision = np.zeros(len(entry))
        if entry.name == 'camera':
            precision[:] = np.inf
            precision[problem.free] = 1.0 / problem.prior_sigma[problem.free] ** 2
        elif entry.name == 'mountings':
            precision[:] = problem.mounting_sigma_rad**-2
        elif entry.name in SIGMA:
            precision[:] = SIGMA[entry.name] ** -2
        elif entry.name == 'field':
            precision[:] = np.inf
            if field_px is not None:
                precision[:] = (octave_size(given) / field_px[octaves(given)]) ** 2
        parts.append(precision)
    of_image = np.r_[np.zeros(3), shape_px**-2.0, np.ones(3)]
    return np.concatenate([*parts, np.tile(of_image, IMAGES)])


def octaves(given: Small) -> Indices:
    """Octave of each coefficient by the wavelength of its label: longer than the width, half."""
    found = []
    for label in given.layout['field'].labels:
        i, j = map(int, label.split('_')[1:3])
        waves_per_px = np.hypot(i / (2.7 * WIDTH), j / (2.7 * HEIGHT))
        found.append(sum(waves_per_px * WIDTH > limit * (1 + 1e-9) for limit in (1, 2)))
    return np.array(found)


def octave_size(given: Small) -> Floats:
    """Root of the number of terms along one axis of the octave of each coefficient."""
    octave = octaves(given)
    return np.asarray(np.sqrt(np.bincount(octave)[octave] / 2.0))


def prior_offset(given: Small) -> Floats:
    """Values (P + 11 m,) at the state less the prior means; used where there is a prior."""
    offset = {
        'camera': given.state.parameters - given.problem.prior_parameters,
        'mountings': given.state.mountings,
        'readout': np.array([-0.004]),
    }
    shared = [offset.get(e.name, np.zeros(len(e))) for e in given.layout.shared]
    return np.concatenate([*shared, np.zeros(OWN * IMAGES)])


def solution(problem: Dense, precision: Floats, offset: Floats) -> tuple[Floats, Floats, float]:
    """Mean, covariance (zero if held), log evidence of the proper priors up to a constant."""
    free = np.isfinite(precision)
    X = np.concatenate([problem.stars, problem.trackers])[:, free]
    r = np.concatenate([problem.residual, -problem.error])
    N = X.T @ X + np.diag(precision[free])
    g = X.T @ r - precision[free] * offset[free]
    size = 1.0 / np.sqrt(np.diag(N))
    inverse = size[:, None] * np.linalg.inv(N * np.outer(size, size)) * size
    mean, covariance = np.zeros(len(free)), np.zeros((len(free), len(free)))
    mean[free] = inverse @ g
    covariance[np.ix_(free, free)] = inverse
    log_det = np.linalg.slogdet(N * np.outer(size, size))[1] - 2.0 * np.log(size).sum()
    log_prior = np.log(precision[free][precision[free] > 0]).sum()
    evidence = 0.5 * (g @ inverse @ g - log_det + log_prior)
    return mean, covariance, float(evidence)
