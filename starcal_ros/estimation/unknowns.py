# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The unknowns of a calibration, in one list.

Whatever is not known exactly is an entry: its name, its labels, the derivative of a star's pixel
by it, and a Gaussian prior.  A shared unknown has one value for all images; an image unknown has
one for each.  There are three forms of derivative:

- ``camera``: it changes the parameters of the camera of image k by the matrix ``camera[k]``;
- ``turn``: it turns the direction of each star by a small rotation in the camera frame, in
  proportion to a number of the star where there is one (``of_star``);
- ``functions``: it displaces pixels along u and along v by functions of the pixel.

An unknown may also turn the camera relative to the star tracker of an image (``tracker``): the
alignment does, and the rotation of an image.

`UNKNOWNS` has a row for each: how its entry is made, its line in the budget of the sigma, and how
its prior is tested.  To add an unknown, add its row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import eval_jacobi

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera.detector_field import basis, basis_and_products, cosine_terms
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD, FASTEST_M_S, SPEED_OF_LIGHT_M_S
from starcal_ros.estimation.amplitudes import LogPrior
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import (
    image_alignment,
    mounting_errors_rad,
    mounting_turns,
    parameters_chain,
    Problem,
    State,
    turn_derivatives,
    turns_chain,
)
from starcal_ros.estimation.refraction import Refraction, ZENITH_SIGMA_RAD
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.records import ALIGNMENT_NAMES
from starcal_ros.sky.astrometry import SIDEREAL_RAD_S
from starcal_ros.text import significant

Turn = Callable[[Floats, Floats, Indices], Floats]
"""Small rotations (3, q, n) of stars by q unit unknowns, from pixels (2, n), directions in the
camera frame (3, n) and image numbers (n,)."""
Scalars = Callable[[Floats], Floats]
"""Values (t, n) of t functions at pixels (2, n)."""

IMAGE_ROTATION = slice(0, 3)
"""Place of the rotation among the unknowns of an image; it moves as `moved` says."""
_FOCAL_MODES = {
    'scale_px': (1.0, 0.0, 1.0),
    'stretch_px': (1.0, 0.0, -1.0),
    'shear_px': (0.0, 1.0, 0.0),
}
"""Changes of fx, skew and fy."""
_TREND = 1e-4  # a lens that warms by some degrees changes its focal length by that share, rms
_SCALE_BY_COLOUR = 3e-4  # per mag of BP - RP: blue and red stars are 0.5 px apart in a corner
_NO_TURN_RAD = 1e-8  # 2 milliarcseconds within an image move no estimate
FIELD_OCTAVES = 3  # to a quarter of the width; a fourth takes 3.4 times as long (experiments.md)
_SHOWN = 1e-2  # singular values below that share of the largest are shown by a border alone
CHANGE = 'change from image to image'  # one line of the budget for the shapes and their trend


@dataclass(frozen=True)
class Unknown:
    """
    One entry of the list: q numbers.

    Attributes
    ----------
    name : str
    labels : tuple of q str
        With the unit as suffix where there is one.
    sigma : (q,)
        1-sigma of the prior; infinite: none.  The amplitude of a group of priors that is
        estimated multiplies it.
    offset : (q,)
        Value at the state, less the prior mean.  What displaces stars in proportion to its value
        stays zero in the state: the equations are linear in it.
    of_image : bool
        True if each image has a value of its own.
    camera : (m, p, q) or None
        Change of the camera parameters of each image.
    turn : Turn or None
    of_star : (n,) or None
        Factor on the turn of each observation, as the colour of its star.
    functions : Scalars or None
        q is twice their number: those of u, then those of v.
    products : callable or None
        Their values (t, n) and the sums (k, t, t) of their products over pixels (2, n) with
        weights (k, n).
    octave : (q,) or None
        Octave of each coefficient of those functions.
    log_px : LogPrior
        Prior of the amplitude of the first octave.
    term : (q,) or None
        A likely combination of the functions, 1 px, with an amplitude of its own besides.
    tracker : (m, 3, q) or None
        Rotation of the camera, as the star tracker of each image predicts it.
    widest : float or (q,)
        Largest 1-sigma that is possible at all, whatever a data sheet says.
    plausible_sigma : float
        What stars show to be much farther than this 1-sigma has to be stated.
    """

    name: str
    labels: tuple[str, ...]
    sigma: Floats
    offset: Floats
    of_image: bool = False
    camera: Floats | None = None
    turn: Turn | None = None
    of_star: Floats | None = None
    functions: Scalars | None = None
    products: Callable[[Floats, Floats], tuple[Floats, Floats]] | None = None
    octave: Indices | None = None
    log_px: LogPrior = dataclasses.field(default_factory=LogPrior)
    term: Floats | None = None
    tracker: Floats | None = None
    widest: Floats | float = np.inf
    plausible_sigma: float = np.inf

    @property
    def kind(self) -> Kind:
        """Row of `UNKNOWNS`."""
        return UNKNOWNS[self.name]

    def __len__(self) -> int:
        """Return the number of unknowns of the entry."""
        return len(self.labels)

    def turns(self, pixels: Floats, directions: Floats, image: Indices, row: Indices) -> Floats:
        """Return the small rotations (3, q, n) of the observations ``row`` (n,), by ``turn``."""
        assert self.turn is not None
        by = self.turn(pixels, directions, image)
        return by if self.of_star is None else by * self.of_star[row]


@dataclass(frozen=True)
class Layout:
    """The list of unknowns, and where each stands among those that are shared."""

    entries: tuple[Unknown, ...]

    @functools.cached_property
    def shared(self) -> tuple[Unknown, ...]:
        """Entries with one value for all images; the field last."""
        shared = [entry for entry in self.entries if not entry.of_image]
        return tuple(sorted(shared, key=lambda entry: entry.functions is not None))

    @functools.cached_property
    def of_image(self) -> tuple[Unknown, ...]:
        """Entries with a value for each image, after its rotation."""
        return tuple(entry for entry in self.entries if entry.of_image)

    @functools.cached_property
    def places(self) -> dict[str, slice]:
        """Place of each shared entry by name, and of each image entry among those of an image."""
        found = {}
        for group, first in ((self.shared, 0), (self.of_image, IMAGE_ROTATION.stop)):
            for entry in group:
                found[entry.name] = slice(first, first + len(entry))
                first += len(entry)
        return found

    @functools.cached_property
    def count(self) -> int:
        """Number of shared unknowns."""
        return sum(map(len, self.shared))

    @functools.cached_property
    def labels(self) -> tuple[str, ...]:
        """Labels of the shared unknowns."""
        return tuple(label for entry in self.shared for label in entry.labels)

    def image_precision(self, shape_sigma_px: Floats | float) -> Floats:
        """Prior precisions (b,) of the unknowns of an image; ``shape_sigma_px`` (s,)."""
        precision = np.concatenate([np.zeros(3), *(entry.sigma**-2.0 for entry in self.of_image)])
        if 'shape' in self:
            precision[self.places['shape']] = np.asarray(shape_sigma_px, np.float64) ** -2.0
        return precision

    def __getitem__(self, name: str) -> Unknown:
        """Return the entry of a name."""
        return next(entry for entry in self.entries if entry.name == name)

    def __contains__(self, name: str) -> bool:
        """Return True if the list has an entry of a name."""
        return name in self.places

    def of(self, names: Sequence[str]) -> Indices:
        """Return the places of the shared entries of these names, in their order."""
        places = [np.arange(self.count)[self.places[name]] for name in names if name in self]
        return np.concatenate([np.empty(0, np.int64), *places])

    @property
    def field(self) -> Unknown:
        """Entry of the field over the detector."""
        return self['field']

    @property
    def shape(self) -> Unknown:
        """Entry of the changes of the camera from image to image."""
        return self['shape']

    @property
    def shape_at(self) -> slice:
        """Place of the shape among the unknowns of an image."""
        return self.places['shape']

    @functools.cached_property
    def field_at(self) -> Indices:
        """Places of the coefficients of the field; none in a list without it."""
        return self.of(['field'])

    @functools.cached_property
    def trend_at(self) -> Indices:
        """Places of shared unknowns that change the camera from image to image."""
        return self.of([entry.name for entry in self.shared if entry.kind.cause == CHANGE])

    @functools.cached_property
    def in_state(self) -> Indices:
        """Places of the shared unknowns that the search moves."""
        return self.of([entry.name for entry in self.shared if entry.kind.in_state])

    @functools.cached_property
    def line_of_sight_at(self) -> Indices:
        """Places of the shared unknowns on which lines of sight depend."""
        return self.of(['camera', 'alignment', 'field'])

    @functools.cached_property
    def prior_precision(self) -> Floats:
        """Diagonal (count,) of the prior's information on the shared unknowns."""
        sigma = np.concatenate([entry.sigma for entry in self.shared])
        with np.errstate(divide='ignore'):  # held: infinite
            return np.asarray(sigma**-2.0)

    @functools.cached_property
    def prior_offset(self) -> Floats:
        """Values (count,) of the shared unknowns at the state, less their prior means."""
        return np.concatenate([entry.offset for entry in self.shared])


@dataclass(frozen=True)
class Assumptions:
    """
    Priors of what an ensemble does not state, from the options: 1-sigma.

    Attributes
    ----------
    velocity_m_s : float
        Each component of the velocity of the observer.
    readout_s : float, float
        Time from the first to the last row: mean and 1-sigma.
    stamp_s : float
        Offset of all stamps against the attitudes.
    refraction : Refraction or None
        About a zenith that is not known exactly; None: in space, or corrected.
    lens_log_px : LogPrior
        Prior of the residual of the lens.
    plausible_m_s : float
        Plausible velocity against the Earth where none is given.
    colour : (n,) or None
        Colour of the star of each observation, mag from their mean; None: not known.
    """

    velocity_m_s: float
    readout_s: tuple[float, float]
    stamp_s: float
    refraction: Refraction | None = None
    lens_log_px: LogPrior = dataclasses.field(default_factory=LogPrior)
    plausible_m_s: float = np.inf
    colour: Floats | None = None


def unknowns_in_state(problem: Problem, state: State) -> Layout:
    """Return the list of the unknowns that the search moves: those of camera and alignment."""
    p, q = problem.camera_count, len(state.focal)
    m = len(state.camera_from_icrf)
    chain = (
        parameters_chain(state.parameters, state.focal, problem.above_reference_k)
        if q
        else np.broadcast_to(np.eye(p), (m, p, p))
    )
    sigma = np.zeros(p)  # held parameters keep a sigma of zero
    sigma[problem.free] = problem.prior_sigma[problem.free]
    offset = state.parameters - problem.prior_parameters
    widest = np.where(problem.is_weak, sigma, np.inf)
    focal = tuple(f'focal_temperature_{i}' for i in range(1, q + 1))
    entries = [
        Unknown(
            'camera',
            problem.parameter_names,
            sigma,
            offset,
            camera=chain[:, :, :p],
            widest=widest,
        ),
        Unknown('focal', focal, np.full(q, np.inf), state.focal, camera=chain[:, :, p:]),
        *_turns_of_camera(problem, state),
    ]
    return Layout(tuple(entry for entry in entries if len(entry)))


def _turns_of_camera(problem: Problem, state: State) -> list[Unknown]:
    """Return alignment, its rate and the mountings: what turns the camera by the star tracker."""
    turns = _turn_chain(problem, state)
    rate = len(state.rate)
    mountings = tuple(
        f'star_tracker_{k}_{axis}'
        for k in range(2, len(state.mountings) // 3 + 2)
        for axis in ('x', 'y', 'z')
    )
    return [
        Unknown(
            'alignment', ALIGNMENT_NAMES, np.full(3, np.inf), np.zeros(3), tracker=turns[:, :, :3]
        ),
        Unknown(
            'rate',
            tuple(f'{name}_temperature' for name in ALIGNMENT_NAMES[:rate]),
            np.full(rate, np.inf),
            state.rate,
            tracker=turns[:, :, 3 : 3 + rate],
        ),
        Unknown(
            'mountings',
            mountings,
            np.full(len(mountings), problem.mounting_sigma_rad),
            state.mountings,
            tracker=turns[:, :, 3 + rate :],
        ),
    ]


def _turn_chain(problem: Problem, state: State) -> Floats:
    """Return how alignment angles, rate and mountings turn the camera of each image: (m, 3, a)."""
    m = len(state.camera_from_icrf)
    chain: Floats = np.tile(np.eye(3), (m, 1, 1))
    if len(state.rate):
        chain = turns_chain(state.rate, problem.above_reference_k)
    if problem.first_from_star_tracker is None:
        return chain
    own = turn_derivatives(mounting_errors_rad(problem, state))
    of_mountings = np.zeros((m, 3, len(state.mountings)))
    for k in range(len(state.mountings) // 3):
        here = problem.star_tracker == k + 1
        of_mountings[here, :, 3 * k : 3 * k + 3] = own[here]
    turned = mounting_turns(problem, state).as_matrix() @ chain
    return np.concatenate([turned, of_mountings], axis=-1)


def moved(
    problem: Problem, state: State, layout: Layout, shared: Floats, rotations: Floats
) -> State:
    """
    Return the state after a step: parameters add, rotations turn (Eq. 11).

    Parameters
    ----------
    shared : (P,)
        Step of the shared unknowns.
    rotations : (m, 3)
        Small rotations of the images.
    """
    places = layout.places

    def step(name: str, value: Floats) -> Floats:
        return value + shared[places[name]] if name in layout else value

    turn = Rotation.from_rotvec(-shared[places['alignment']])
    after = State(
        parameters=step('camera', state.parameters),
        camera_from_star_tracker=turn * state.camera_from_star_tracker,
        camera_from_icrf=state.camera_from_icrf,
        focal=step('focal', state.focal),
        rate=step('rate', state.rate),
        mountings=step('mountings', state.mountings),
    )
    # The camera follows what the star tracker predicts, by large angles too.
    by = np.zeros_like(rotations)
    for entry in layout.shared:
        if entry.tracker is not None and entry.kind.in_state:
            by += np.einsum('mij,j->mi', entry.tracker, shared[places[entry.name]])
    predicted = image_alignment(problem, after) * image_alignment(problem, state).inv()
    own = Rotation.from_rotvec(by - rotations) * predicted * state.camera_from_icrf
    return dataclasses.replace(after, camera_from_icrf=own)


@dataclass(frozen=True)
class EntryInputs:
    """
    Inputs of the entries of a calibration at a state.

    ``rates`` are in the frame of the camera; ``size`` is that of the detector, (width, height) px.
    """

    problem: Problem
    state: State
    rates: Rates
    size: tuple[int, int]
    assumed: Assumptions

    @property
    def camera_from_icrf(self) -> Floats:
        """Rotations (m, 3, 3) of the images."""
        return np.asarray(self.state.camera_from_icrf.as_matrix())


def unknowns_of(given: EntryInputs) -> Layout:
    """Return the list of unknowns of a calibration at a state."""
    made = (kind.make(given) for kind in UNKNOWNS.values() if kind.make is not None)
    entries = *unknowns_in_state(given.problem, given.state).entries, *made
    return Layout(tuple(entry for entry in entries if entry is not None and len(entry)))


def readout_rms_s(layout: Layout, mean: Floats, covariance: Floats, assumed: Assumptions) -> float:
    """Return the rms time of read-out: by a posterior, where the errors of rates show it."""
    if not {'rates', 'readout'} <= set(layout.places):
        return math.hypot(*assumed.readout_s)
    at = layout.places['readout'].start
    return math.hypot(mean[at], covariance[at, at] ** 0.5)


def _shape(given: EntryInputs) -> Unknown:
    """
    Return the entry of the changes of the camera from image to image.

    A lens that warms changes its scale, one that sags or is turned its decentring, by p1 and p2
    where the lens model has them: 1 px displaces stars as far out as the corners by 1 to 3 px.
    """
    problem, state = given.problem, given.state
    names = problem.parameter_names
    decentring = [name for name in ('p1', 'p2') if name in names]
    labels = (*_FOCAL_MODES, *(f'{name}_px' for name in decentring))
    modes = np.zeros((problem.camera_count, len(labels)))
    modes[:3, :3] = np.array(list(_FOCAL_MODES.values())).T
    for k, name in enumerate(decentring, 3):
        modes[names.index(name), k] = 4.0 * abs(state.parameters[0]) / math.hypot(*given.size) ** 2
    count, m = len(labels), len(state.camera_from_icrf)
    camera = np.broadcast_to(modes, (m, *modes.shape))
    return Unknown('shape', labels, np.ones(count), np.zeros(count), of_image=True, camera=camera)


def _trend(given: EntryInputs) -> Unknown | None:
    """
    Return the entry of a scale that changes in proportion to time, as that of a lens that warms.

    Changes that each image has by itself do not explain it as well as a velocity does where the
    line of sight turns slowly.  Where temperatures are given, the scale changes with them.
    """
    problem, state = given.problem, given.state
    if len(state.focal) or not problem.time_s.any():
        return None
    late = problem.time_s / np.sqrt((problem.time_s**2).mean())
    modes = np.zeros((len(late), problem.camera_count, 1))
    modes[:, :3, 0] = np.outer(late, _FOCAL_MODES['scale_px'])
    sigma = np.array([_TREND * abs(float(state.parameters[0]))])
    return Unknown('trend', ('scale_trend_px',), sigma, np.zeros(1), camera=modes)


def _velocity(given: EntryInputs) -> Unknown | None:
    """Return the entry of the velocity of the observer."""
    if not given.assumed.velocity_m_s > 0:
        return None
    return Unknown(
        'velocity',
        ('velocity_x_m_s', 'velocity_y_m_s', 'velocity_z_m_s'),
        np.full(3, given.assumed.velocity_m_s),
        np.zeros(3),
        turn=functools.partial(_by_velocity, given.camera_from_icrf),
        widest=FASTEST_M_S,
        plausible_sigma=given.assumed.plausible_m_s,
    )


def _refraction(given: EntryInputs) -> Unknown | None:
    """Return the entry of the size of refraction."""
    if (air := given.assumed.refraction) is None:
        return None
    label, sigma = ('refraction_arcsec',), np.array([air.sigma_arcsec])
    turn = functools.partial(air.by_size, given.camera_from_icrf)
    return Unknown('refraction', label, sigma, np.zeros(1), turn=turn)


def _site(given: EntryInputs) -> Unknown | None:
    """Return the entry of latitude and sidereal times."""
    if (air := given.assumed.refraction) is None:
        return None
    turn, q = functools.partial(air.by_site, given.camera_from_icrf), len(air.labels)
    sigma = np.full(q, air.site_sigma_rad)
    return Unknown('site', air.labels, sigma, np.zeros(q), turn=turn, widest=ZENITH_SIGMA_RAD)


def _colour(given: EntryInputs) -> Unknown | None:
    """Return the entry of a scale that changes with the colour of the star."""
    if given.assumed.colour is None:
        return None
    label, sigma = ('scale_by_colour_per_mag',), np.array([_SCALE_BY_COLOUR])
    turn = functools.partial(_by_scale, given.problem.model)
    return Unknown('colour', label, sigma, np.zeros(1), turn=turn, of_star=given.assumed.colour)


def _readout(given: EntryInputs) -> Unknown | None:
    """Return the entry of the time of read-out, which a camera that turns shows."""
    labels, sigma, offset, by_time = _timing(given, 'readout', *given.assumed.readout_s)
    turn = functools.partial(_by_readout, by_time, given.size[1])
    return Unknown('readout', labels, sigma, offset, turn=turn)


def _stamps(given: EntryInputs) -> Unknown | None:
    """Return the entry of the offset of the stamps, which a camera that turns shows."""
    labels, sigma, offset, by_time = _timing(given, 'stamp_offset', 0.0, given.assumed.stamp_s)
    return Unknown('stamps', labels, sigma, offset, tracker=by_time)


def _timing(
    given: EntryInputs, name: str, mean_s: float, sigma_s: float
) -> tuple[tuple[str, ...], Floats, Floats, Floats]:
    """
    Return labels, 1-sigma (q,), offset (q,) and turns (m, 3, q) of a time that is not known.

    Without rates they are three turns, by one rate that all images may have.  Without labels the
    camera turns in no image, or the time is known.
    """
    labels: tuple[str, ...] = (f'{name}_s',)
    by_time = given.rates.rad_s[:, :, None]
    if not np.isfinite(by_time).all():
        rate_rad_s = float(np.linalg.norm(given.rates.root_rad_s[0, 0]))
        by_time = np.broadcast_to(np.eye(3), (len(by_time), 3, 3))
        mean_s, sigma_s = 0.0, rate_rad_s * math.hypot(mean_s, sigma_s)
        labels = tuple(f'{name}_{k}_rad' for k in 'xyz')
    if not (by_time.any() and sigma_s > 0):
        labels = ()
    one = np.ones(len(labels))
    return labels, sigma_s * one, -mean_s * one, by_time


def _errors_of_rates(given: EntryInputs) -> Unknown | None:
    """
    Return the entry of the errors of the rates: three turns of each image over its read-out.

    In units of their priors.
    """
    rates = given.rates
    turns = rates.readout_s * rates.root_rad_s
    if np.abs(turns).max() < _NO_TURN_RAD or not np.isfinite(rates.rad_s).all():
        return None
    turn = functools.partial(_by_readout, turns, given.size[1])
    labels = ('rate_error_x', 'rate_error_y', 'rate_error_z')
    return Unknown('rates', labels, np.ones(3), np.zeros(3), of_image=True, turn=turn)


def _by_velocity(
    camera_from_icrf: Floats, pixels: Floats, directions: Floats, image: Indices
) -> Floats:
    """
    Small rotations (3, 3, n) of stars by the velocity of the observer, per m/s.

    Stars move towards it: ``d e = (v - e (e . v)) / c`` (aberration to first order), which the
    passive rotation ``d e x e = v x e / c`` gives.
    """
    del pixels
    # Columns: ICRF axes in the camera frame.  To take along an axis is much quicker than to index.
    x, y, z = np.take(camera_from_icrf.transpose(1, 2, 0), image, axis=2)
    e_x, e_y, e_z = directions / SPEED_OF_LIGHT_M_S
    return np.stack([y * e_z - z * e_y, z * e_x - x * e_z, x * e_y - y * e_x])


def _by_scale(model: str, pixels: Floats, directions: Floats, image: Indices) -> Floats:
    """Small rotations (3, 1, n) of stars away from the optical axis, as a longer focal length."""
    del pixels, image
    x, y, z = directions
    sine = np.hypot(x, y)
    if LENSES[model].is_angular:  # the angle in place of its tangent
        z = np.arctan2(sine, z) / np.maximum(sine, 1e-12)
    return np.stack([z * y, -z * x, 0.0 * x])[:, None]


def _by_readout(
    turns: Floats, height: int, pixels: Floats, directions: Floats, image: Indices
) -> Floats:
    """Small rotations (3, q, n) of stars by turns (m, 3, q) from the first to the last row."""
    del directions
    late = (pixels[1] + 0.5) / height - 0.5
    return np.asarray(np.take(turns.transpose(1, 2, 0), image, axis=2) * late)


def _field(given: EntryInputs) -> Unknown:
    """
    Return the entry of the field over the detector: coefficients of cosines.

    An amplitude of 1 px of an octave is its RMS over the detector along each axis.
    """
    width, height = given.size
    terms, octave = cosine_terms(width, height, FIELD_OCTAVES)

    def functions(pixels: Floats) -> Floats:
        return basis(pixels.T, width, height, FIELD_OCTAVES).T

    def products(pixels: Floats, weights: Floats) -> tuple[Floats, Floats]:
        return basis_and_products(pixels.T, weights, width, height, FIELD_OCTAVES)

    labels = tuple(f'field_{i}_{j}_{axis}_px' for axis in 'uv' for i, j in terms)
    sigma = 1.0 / np.sqrt(np.bincount(octave)[octave])
    sigma = np.concatenate([sigma, sigma])
    octave = np.concatenate([octave, octave])
    return Unknown(
        'field',
        labels,
        sigma,
        np.zeros(len(labels)),
        functions=functions,
        products=products,
        octave=octave,
        log_px=given.assumed.lens_log_px,
        term=_next_lens_term(width, height),
    )


@functools.lru_cache(maxsize=16)
def _next_lens_term(width: int, height: int) -> Floats:
    """
    Return the coefficients (q,) of the next radial term of a lens, 1 px RMS along each axis.

    The term is ``r^9`` less what lower ones, which a lens model has, can take of it: the radial
    polynomial of Zernike ``R_9^1``, which is orthogonal to r, r^3, r^5 and r^7 over the circle
    through the corners (Born & Wolf, 9.2.1).  In the outermost corners it is steeper than the
    field.
    """
    at = np.stack(np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in (41, 41)), indexing='ij'))
    from_centre = at.reshape(2, -1).T * np.array([width, height]) / math.hypot(width, height)
    r2 = (from_centre**2).sum(axis=1, keepdims=True)
    term = from_centre * eval_jacobi(4, 0.0, 1.0, 2.0 * r2 - 1.0)  # R_9^1 over r
    term /= np.sqrt((term**2).mean())
    pixels = (at.reshape(2, -1).T + 1.0) / 2.0 * np.array([width, height]) - 0.5
    phi = basis(pixels, width, height, FIELD_OCTAVES)
    found, *_ = np.linalg.lstsq(phi, term, rcond=_SHOWN)
    coefficients: Floats = np.asarray(found.T.ravel(), np.float64)
    coefficients.setflags(write=False)
    return coefficients


Option = tuple[str, str, float]
"""Option that may be stated, a plausible value, and its variance over that of the prior."""
NO_OPTION: Option = '', '', 1.0


@dataclass(frozen=True)
class PriorTest:
    """
    Test of the prior of an unknown, by an estimate without it, in words.

    The names of its numbers in the checks begin with ``starts``: labels, or by ``as_stated`` name
    and unit of what an operator states.  ``is_added``: the number is what the stars add to a value
    that is stated.  The remedy is for a prior that the stars contradict; ``unstated`` are finding
    and remedy in its place where no message of the images states the value.
    """

    starts: tuple[str, ...] = ()
    remedy: str = 'estimate it, or widen its prior (estimate, prior_sigma)'
    is_added: bool = False
    as_stated: Mapping[str, tuple[str, float]] = dataclasses.field(default_factory=dict)
    unstated: tuple[str, str] | None = None


@dataclass(frozen=True)
class Kind:
    """
    Row of `UNKNOWNS`: all that is known of an unknown before any data.

    Attributes
    ----------
    make : callable or None
        Returns its entry, or None where it has no effect.  None: `unknowns_in_state` makes it.
    cause : str
        Line of the budget of the sigma; empty: its variance is in that of the stars.
    line : int
        Place of that line among those of the unknowns.
    of_tracker : bool
        True if there is no such line without a star tracker.
    assumption : callable
        Text of that line by the list, the posterior mean (P,) and the options.
    option : callable
        What may be stated to lower the sigma, by the list and the options.
    needs_dates : bool
        True if a statement of it takes effect only in images that have a date.
    remedy : str
        What else lowers it.
    in_state : bool
        True if the search moves it; otherwise it is zero in the state.
    tested : PriorTest or None
        None: the data do not test its prior.
    """

    make: Callable[[EntryInputs], Unknown | None] | None = None
    cause: str = ''
    line: int = 9
    of_tracker: bool = False
    assumption: Callable[[Layout, Floats, CalibrationOptions], str] = lambda *_: (
        'estimated, no prior'
    )
    option: Callable[[Layout, CalibrationOptions], Option] = lambda *_: NO_OPTION
    needs_dates: bool = False
    remedy: str = ''
    in_state: bool = False
    tested: PriorTest | None = None


def _is_sited(layout: Layout) -> bool:
    """Return True if the site of a camera on the ground is stated."""
    return bool(layout['site'].sigma[0] < ZENITH_SIGMA_RAD)


def _size(entry: Unknown, unit: str, size: float = 1.0) -> str:
    return f'{significant(float(entry.sigma[0]) / size, 3)}{unit}'


def _angle(entry: Unknown) -> str:
    return _size(entry, '″', ARCSECOND_RAD)


def _velocity_text(layout: Layout, _: Floats, options: CalibrationOptions) -> str:
    entry = layout['velocity']
    is_fast = entry.sigma[0] >= 1e3
    size = f'{_size(entry, " km/s", 1e3) if is_fast else _size(entry, " m/s")} per axis'
    if options.velocity_sigma_m_s >= 0:
        return f'{size} stated'
    is_given = math.isinf(entry.plausible_sigma)
    return f'{"given" if is_given else "no barycentric one given"}: {size} assumed'


def _velocity_option(layout: Layout, options: CalibrationOptions) -> Option:
    if options.velocity_sigma_m_s >= 0:
        return NO_OPTION
    left = (10.0 / layout['velocity'].sigma[0]) ** 2
    return 'observer_velocity_m_s (or topic velocity)', 'known to 10 m/s', left


def _refraction_text(layout: Layout, *_: object) -> str:
    of_site = 'air at the site' if _is_sited(layout) else 'site not given'
    return f'{of_site}: {_size(layout["refraction"], " arcsec")} at 45 degrees assumed'


def _site_option(layout: Layout, _: CalibrationOptions) -> Option:
    return NO_OPTION if _is_sited(layout) else ('latitude_deg and longitude_deg', 'known', 0.0)


def _colour_text(layout: Layout, mean: Floats, _: CalibrationOptions) -> str:
    ppm = significant(1e6 * float(mean[layout.places['colour']][0]), 3)
    return f'estimated: {ppm} ppm of the scale per mag of BP - RP'


def _readout_text(layout: Layout, _: Floats, options: CalibrationOptions) -> str:
    entry = layout['readout']
    if options.shutter == 'unknown':
        return f'shutter unknown: {_time_text(entry)}'
    return _time_text(entry) if len(entry) > 1 else f'{_size(entry, " ms", 1e-3)} stated'


def _time_text(entry: Unknown) -> str:
    if len(entry) > 1:  # three turns, where no rate is known
        return f'rate not known: {_angle(entry)} per axis assumed'
    return f'{_size(entry, " ms", 1e-3)} assumed'


def _readout_option(layout: Layout, options: CalibrationOptions) -> Option:
    is_unknown, rates = options.shutter == 'unknown', 'star_tracker_rate_rad_s of the images'
    if len(layout['readout']) > 1 and is_unknown:  # no image has a rate
        return f'shutter, or {rates}', 'global, or known', 0.0
    if len(layout['readout']) > 1:
        return rates, 'known', 0.0
    known = 'global, or rolling with a known readout_s'
    return ('shutter (and readout_s)', known, 0.0) if is_unknown else NO_OPTION


def _a_tenth_of(option: str) -> Callable[[Layout, CalibrationOptions], Option]:
    """Return that a tenth of an option that is a sigma may be stated."""
    return lambda _, options: (option, significant(0.1 * getattr(options, option), 2), 0.01)


UNKNOWNS: dict[str, Kind] = {
    'camera': Kind(in_state=True, tested=PriorTest()),
    'focal': Kind(
        in_state=True,
        cause='temperature',
        line=8,
        remedy='take images over a wider range of temperatures',
    ),
    'alignment': Kind(in_state=True),
    'rate': Kind(in_state=True, cause='temperature', line=8),
    'mountings': Kind(
        in_state=True,
        cause='mountings',
        line=6,
        of_tracker=True,
        assumption=lambda layout, *_: f'{_angle(layout["mountings"])} per angle assumed',
        option=_a_tenth_of('star_tracker_mounting_sigma_arcsec'),
        remedy='state the 1-sigma of the mountings (star_tracker_mounting_sigma_arcsec)',
        tested=PriorTest(('mounting',), 'check more_alignments', is_added=True),
    ),
    'trend': Kind(_trend, cause=CHANGE, line=0),
    'velocity': Kind(
        _velocity,
        cause='velocity',
        line=1,
        assumption=_velocity_text,
        option=_velocity_option,
        remedy='state the velocity (topic, observer_velocity_m_s; photographs: observer)',
        tested=PriorTest(
            ('velocity',),
            'correct it so; on the ground state observer: ground',
            is_added=True,
            unstated=(
                'none was received, that of the Earth was assumed',
                'publish it, or check the date',
            ),
        ),
    ),
    'refraction': Kind(_refraction, cause='refraction', line=2, assumption=_refraction_text),
    'site': Kind(
        _site,
        cause='refraction',
        line=2,
        option=_site_option,
        needs_dates=True,
        tested=PriorTest(
            ('latitude', 'clock'),
            'check site and UTC, or state observer: ground alone',
            is_added=True,
            as_stated={
                'latitude_rad': ('latitude_deg', math.degrees(1.0)),
                'sidereal_time_1_rad': ('clock_offset_min', 1.0 / (60.0 * SIDEREAL_RAD_S)),
            },
        ),
    ),
    'colour': Kind(_colour, cause='lateral colour', line=7, assumption=_colour_text),
    'readout': Kind(
        _readout,
        cause='read-out',
        line=3,
        assumption=_readout_text,
        option=_readout_option,
        remedy='state the shutter and its read-out time (shutter, readout_s)',
        tested=PriorTest(('readout',), 'check shutter and readout_s'),
    ),
    'stamps': Kind(
        _stamps,
        cause='stamps',
        line=4,
        of_tracker=True,
        assumption=lambda layout, *_: _time_text(layout['stamps']),
        option=_a_tenth_of('stamp_sigma_s'),
        remedy='state the uncertainty of the time stamps (stamp_sigma_s)',
        tested=PriorTest(
            ('stamp',),
            'check stamp_offset_s and the clocks of camera and star tracker',
            is_added=True,
        ),
    ),
    'field': Kind(
        _field,
        cause='field',
        line=5,
        remedy='take more images with stars at other places on the detector',
    ),
    'shape': Kind(
        _shape,
        cause=CHANGE,
        remedy='use temperatures or one focus; unstated air (observer: ground) changes it',
    ),
    'rates': Kind(_errors_of_rates),
}
"""Name -> row, in the order of the list: those in the state first."""


def remedy_of(cause: str) -> str:
    """Return the remedy against a cause that is an unknown; empty where there is none."""
    remedies = (kind.remedy for kind in UNKNOWNS.values() if kind.cause == cause)
    return next(filter(None, remedies), '')


def prior_test_of(name: str) -> PriorTest:
    """Return how a prior is tested that a check names so; a camera parameter where none fits."""
    tests = (kind.tested for kind in UNKNOWNS.values() if kind.tested is not None)
    return next((test for test in tests if name.startswith(test.starts)), PriorTest())
