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

To add an unknown, add its entry in `unknowns_of`.

Refraction has three: its size, the latitude of the site and the sidereal time of each image.  They
are there where the observations state a zenith, by a site and its clock or by the stars
(`sky.astrometry`).  All images are of one site: their zeniths have one declination.  Where the
site is stated, or they run as the stamps do, the sidereal times have one error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera.detector_field import basis, basis_products, cosine_terms
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import (
    ARCSECOND_RAD,
    FASTEST_M_S,
    NANOSECONDS_PER_SECOND,
    SPEED_OF_LIGHT_M_S,
)
from starcal_ros.estimation.amplitudes import UNSTATED
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
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.records import ALIGNMENT_NAMES
from starcal_ros.sky.astrometry import LEAST_COSINE, SIDEREAL_RAD_S

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
_DECENTRING = ('p1', 'p2')  # an equidistant lens has none
_TREND = 1e-4  # relative, rms over the images: a lens that warms by some degrees
_SCALE_BY_COLOUR = 3e-4  # relative, per mag of BP - RP: 0.5 px in a corner, blue to red
_NO_TURN_RAD = 1e-8  # within an image: 2 milliarcseconds
FIELD_OCTAVES = 3  # to a quarter of the width; a fourth takes 3.4 times as long (experiments.md)
_SHOWN = 1e-2  # least singular value over the largest: none that only a border shows


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
        Sums (k, t, t) of their products over pixels (2, n) with weights (k, n).
    octave : (q,) or None
        Octave of each coefficient of those functions.
    log_px : float, float
        Prior of the logarithm of the amplitude of the first octave: mean and 1-sigma.
    term : (q,) or None
        A likely combination of the functions, 1 px, with an amplitude of its own besides.
    tracker : (m, 3, q) or None
        Rotation of the camera, as the star tracker of each image predicts it.
    widest : float or (q,)
        Largest 1-sigma that is possible at all, whatever a data sheet says.
    usual : float
        1-sigma of what is usual: what stars show to be much farther has to be stated.
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
    products: Callable[[Floats, Floats], Floats] | None = None
    octave: Indices | None = None
    log_px: tuple[float, float] = UNSTATED
    term: Floats | None = None
    tracker: Floats | None = None
    widest: Floats | float = np.inf
    usual: float = np.inf

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
        return tuple(entry for entry in self.entries if not entry.of_image)

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
    lens_log_px : float, float
        Logarithm of the residual of the lens: mean and 1-sigma.
    usual_m_s : float
        Usual velocity against the Earth where none is given.
    colour : (n,) or None
        Colour of the star of each observation, mag from their mean; None: not known.
    """

    velocity_m_s: float
    readout_s: tuple[float, float]
    stamp_s: float
    refraction: Refraction | None = None
    lens_log_px: tuple[float, float] = UNSTATED
    usual_m_s: float = np.inf
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
        if entry.tracker is not None and entry.name in ('alignment', 'rate', 'mountings'):
            by += np.einsum('mij,j->mi', entry.tracker, shared[places[entry.name]])
    predicted = image_alignment(problem, after) * image_alignment(problem, state).inv()
    own = Rotation.from_rotvec(by - rotations) * predicted * state.camera_from_icrf
    return dataclasses.replace(after, camera_from_icrf=own)


def unknowns_of(
    problem: Problem,
    state: State,
    rates: Rates,
    size: tuple[int, int],
    assumed: Assumptions,
) -> Layout:
    """
    Return the list of unknowns of a calibration at a state.

    Parameters
    ----------
    rates : Rates
        In the frame of the camera.
    size : (width, height)
        Of the detector, px.
    """
    width, height = size
    entries = [*unknowns_in_state(problem, state).entries, *_trend(problem, state)]
    if assumed.velocity_m_s > 0:
        entries.append(
            Unknown(
                'velocity',
                ('velocity_x_m_s', 'velocity_y_m_s', 'velocity_z_m_s'),
                np.full(3, assumed.velocity_m_s),
                np.zeros(3),
                turn=functools.partial(_by_velocity, state.camera_from_icrf.as_matrix()),
                widest=FASTEST_M_S,
                usual=assumed.usual_m_s,
            )
        )
    if assumed.refraction is not None:
        entries += _refraction(assumed.refraction, state.camera_from_icrf.as_matrix())
    if assumed.colour is not None:
        label, sigma = ('scale_by_colour_per_mag',), np.array([_SCALE_BY_COLOUR])
        turn = functools.partial(_by_scale, problem.model)
        colour = Unknown('colour', label, sigma, np.zeros(1), turn=turn, of_star=assumed.colour)
        entries.append(colour)
    entries += _of_timing(rates, height, assumed)
    entries.append(dataclasses.replace(_field(width, height), log_px=assumed.lens_log_px))
    entries.append(_shape(problem, state, size))
    entries += _errors_of_rates(rates, height)
    return Layout(tuple(entry for entry in entries if len(entry)))


def _shape(problem: Problem, state: State, size: tuple[int, int]) -> Unknown:
    """
    Return the entry of the changes of the camera from image to image.

    A lens that warms changes its scale, one that sags or is turned its decentring, by p1 and p2
    where the lens model has them: 1 px displaces stars as far out as the corners by 1 to 3 px.
    """
    names = problem.parameter_names
    decentring = [name for name in _DECENTRING if name in names]
    labels = (*_FOCAL_MODES, *(f'{name}_px' for name in decentring))
    modes = np.zeros((problem.camera_count, len(labels)))
    modes[:3, :3] = np.array(list(_FOCAL_MODES.values())).T
    for k, name in enumerate(decentring, 3):
        modes[names.index(name), k] = 4.0 * abs(state.parameters[0]) / math.hypot(*size) ** 2
    count, m = len(labels), len(state.camera_from_icrf)
    camera = np.broadcast_to(modes, (m, *modes.shape))
    return Unknown('shape', labels, np.ones(count), np.zeros(count), of_image=True, camera=camera)


def _trend(problem: Problem, state: State) -> list[Unknown]:
    """
    Return the entry of a scale that changes in proportion to time, as that of a lens that warms.

    Changes that each image has by itself do not explain it as well as a velocity does where the
    line of sight turns slowly.  Where temperatures are given, the scale changes with them.
    """
    if len(state.focal) or not problem.time_s.any():
        return []
    late = problem.time_s / np.sqrt((problem.time_s**2).mean())
    modes = np.zeros((len(late), problem.camera_count, 1))
    modes[:, :3, 0] = np.outer(late, _FOCAL_MODES['scale_px'])
    sigma = np.array([_TREND * abs(float(state.parameters[0]))])
    return [Unknown('trend', ('scale_trend_px',), sigma, np.zeros(1), camera=modes)]


def _refraction(air: Refraction, camera_from_icrf: Floats) -> list[Unknown]:
    """Return the entries of the size of refraction and of the site."""
    sizes, q = np.array([air.sigma_arcsec]), len(air.labels)
    by_size = functools.partial(air.by_size, camera_from_icrf)
    by_site = functools.partial(air.by_site, camera_from_icrf)
    site = np.full(q, air.site_sigma_rad)
    return [
        Unknown('refraction', ('refraction_arcsec',), sizes, np.zeros(1), turn=by_size),
        Unknown('site', air.labels, site, np.zeros(q), turn=by_site, widest=ZENITH_SIGMA_RAD),
    ]


def _of_timing(rates: Rates, height: int, assumed: Assumptions) -> list[Unknown]:
    """Return the entries of the read-out and of the stamps: what a camera that turns shows."""
    (mean, readout), stamps = assumed.readout_s, assumed.stamp_s
    by_time = rates.rad_s[:, :, None]
    labels: tuple[tuple[str, ...], ...] = ('readout_s',), ('stamp_offset_s',)
    if not np.isfinite(by_time).all():  # the turns by one rate that all images may have
        rate_rad_s = float(np.linalg.norm(rates.root_rad_s[0, 0]))
        by_time = np.broadcast_to(np.eye(3), (len(by_time), 3, 3))
        mean, readout, stamps = 0.0, rate_rad_s * math.hypot(mean, readout), rate_rad_s * stamps
        labels = tuple(tuple(f'{of}_{k}_rad' for k in 'xyz') for of in ('readout', 'stamp_offset'))
    if not by_time.any():
        return []
    entries, one = [], np.ones(by_time.shape[2])
    if readout > 0:
        turn = functools.partial(_by_readout, by_time, height)
        entries.append(Unknown('readout', labels[0], readout * one, -mean * one, turn=turn))
    if stamps > 0:
        entries.append(Unknown('stamps', labels[1], stamps * one, 0.0 * one, tracker=by_time))
    return entries


def _errors_of_rates(rates: Rates, height: int) -> list[Unknown]:
    """
    Return the entry of the errors of the rates: three turns of each image over its read-out.

    In units of their priors.
    """
    turns = rates.readout_s * rates.root_rad_s
    if np.abs(turns).max() < _NO_TURN_RAD or not np.isfinite(rates.rad_s).all():
        return []
    turn = functools.partial(_by_readout, turns, height)
    labels = ('rate_error_x', 'rate_error_y', 'rate_error_z')
    return [Unknown('rates', labels, np.ones(3), np.zeros(3), of_image=True, turn=turn)]


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
    x, y, z = (np.take(camera_from_icrf[:, k].T, image, axis=1) for k in range(3))
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


def _field(width: int, height: int) -> Unknown:
    """
    Return the entry of the field over the detector: coefficients of cosines.

    An amplitude of 1 px of an octave is its RMS over the detector along each axis.
    """
    terms, octave = cosine_terms(width, height, FIELD_OCTAVES)

    def functions(pixels: Floats) -> Floats:
        return basis(pixels.T, width, height, FIELD_OCTAVES).T

    def products(pixels: Floats, weights: Floats) -> Floats:
        return basis_products(pixels.T, weights, width, height, FIELD_OCTAVES)

    labels = tuple(f'field_{i}_{j}_{axis}_px' for axis in 'uv' for i, j in terms)
    sigma = 1.0 / np.sqrt(np.bincount(octave)[octave])
    sigma = np.concatenate([sigma, sigma])
    octave = np.concatenate([octave, octave])
    value = np.zeros(len(labels))
    term = _next_lens_term(width, height)
    return Unknown(
        'field',
        labels,
        sigma,
        value,
        functions=functions,
        products=products,
        octave=octave,
        term=term,
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
    radial = (((126.0 * r2 - 280.0) * r2 + 210.0) * r2 - 60.0) * r2 + 5.0
    term = from_centre * radial
    term /= np.sqrt((term**2).mean())
    pixels = (at.reshape(2, -1).T + 1.0) / 2.0 * np.array([width, height]) - 0.5
    phi = basis(pixels, width, height, FIELD_OCTAVES)
    found, *_ = np.linalg.lstsq(phi, term, rcond=_SHOWN)
    coefficients: Floats = np.asarray(found.T.ravel(), np.float64)
    coefficients.setflags(write=False)
    return coefficients


ZENITH_SIGMA_RAD = 1.0  # latitude and sidereal time unknown: anywhere above the horizon
STATED_SITE_RAD = 0.01  # accuracy of a stated site and clock: 60 km, and two minutes
_ONE_CLOCK_RAD = 1e-6
_MOST_TIMES = 40  # images beyond it share the error of a sidereal time with their neighbours


@dataclass(frozen=True)
class Refraction:
    """
    Stamps (m,) and zeniths (m, 3) of images, and the size of refraction with its 1-sigma.

    The size is that at a zenith distance of 45 degrees; ``site_sigma_rad`` is the 1-sigma of
    latitude and sidereal time.
    """

    time_ns: NDArray[np.int64]
    zenith_icrf: Floats
    size_arcsec: float
    sigma_arcsec: float
    site_sigma_rad: float = ZENITH_SIGMA_RAD

    @functools.cached_property
    def times(self) -> Indices:
        """Number (m,) of the error of the sidereal time of each image."""
        m = len(self.zenith_icrf)
        right_ascension = np.arctan2(self.zenith_icrf[:, 1], self.zenith_icrf[:, 0])
        late_s = (self.time_ns - self.time_ns[0]) / NANOSECONDS_PER_SECOND
        off = np.exp(1j * (right_ascension - right_ascension[0] - SIDEREAL_RAD_S * late_s))
        is_stated = self.site_sigma_rad < ZENITH_SIGMA_RAD
        if is_stated or np.abs(off - 1.0).max() < _ONE_CLOCK_RAD:
            return np.zeros(m, np.int64)
        return np.arange(m) * min(m, _MOST_TIMES) // m

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the unknowns of the site."""
        times = range(int(self.times[-1]) + 1)
        return ('latitude_rad', *(f'sidereal_time_{k + 1}_rad' for k in times))

    def by_size(
        self, camera_from_icrf: Floats, pixels: Floats, directions: Floats, image: Indices
    ) -> Floats:
        """Small rotations (3, 1, n) of stars by the size of refraction, per arcsec."""
        del pixels
        zenith = np.einsum('mij,mj->im', camera_from_icrf, self.zenith_icrf)[:, image]
        turn = np.cross(zenith, directions, axis=0) / _cosine(zenith, directions)
        return np.asarray(ARCSECOND_RAD * turn[:, None])

    def by_site(
        self, camera_from_icrf: Floats, pixels: Floats, directions: Floats, image: Indices
    ) -> Floats:
        """Small rotations (3, q, n) of stars by latitude and sidereal times, per rad."""
        del pixels
        pole = np.array([0.0, 0.0, 1.0])
        east = np.cross(pole, self.zenith_icrf)
        north = np.cross(self.zenith_icrf, east)
        north /= np.maximum(np.linalg.norm(north, axis=1, keepdims=True), 1e-9)
        zenith, by_latitude, by_time = (
            np.einsum('mij,mj->im', camera_from_icrf, axis)[:, image]
            for axis in (self.zenith_icrf, north, east)
        )
        cosine = _cosine(zenith, directions)
        turns = np.zeros((3, len(self.labels), directions.shape[1]))
        for row, change in ((0, by_latitude), (1 + self.times[image], by_time)):
            moved = change - zenith * (np.sum(change * directions, axis=0) / cosine)
            turn = np.cross(moved, directions, axis=0) / cosine
            turns[:, row, np.arange(len(cosine))] = turn
        return self.size_arcsec * ARCSECOND_RAD * turns


def _cosine(zenith: Floats, directions: Floats) -> Floats:
    """Cosines (n,) of zenith distances, at least `LEAST_COSINE`."""
    return np.asarray(np.maximum(np.sum(zenith * directions, axis=0), LEAST_COSINE))
