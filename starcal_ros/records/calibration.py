# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records of a calibration: camera and alignment, covariance, gate checks and provenance.

Its parts are the model checks, the star trackers, the budget of the sigma, and the field over the
detector with the covariance of lines of sight (`residual_field`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import math
import secrets
from typing import Annotated, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, check_plausible
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.record_fields import Count, Finite, Quaternion, Record, Shape, Stamp
from starcal_ros.records.residual_field import MapCovariance, ResidualField
from starcal_ros.text import significant, to_sigma

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

TOTAL = 'total'
TIMES = 'image times'
"""Key of the provenance: where the stamps are from, if the images state none."""
PIXELS_OF = 'image pixels'
"""Key of the provenance: which pixels of image files are those of the camera, if not all."""
FOUND = 'found by the stars'
"""Key of the provenance: parts of the prior, camera or alignment, that nobody has stated."""
ORIGINAL = 'original '
"""Start of the keys of the provenance with the SHA-256 of files that a bag was made from."""
BUDGET_COLUMNS, BUDGET_ROWS = 9, 7
ALIGNMENT_NAMES = ('alignment_x', 'alignment_y', 'alignment_z')


@dataclass(frozen=True, eq=False)
class CameraGeometry(Record):
    """
    The camera and its alignment to the star tracker: the prior, or a calibration.

    ``star_tracker_from_camera_xyzw`` is (4,): the orientation of the camera in the star tracker
    frame, as in messages.

    >>> import starcal_ros
    >>> camera = starcal_ros.CameraModel(1024, 768, [2000, 0, 2000, 511.5, 383.5, 0, 0, 0, 0, 0])
    >>> geometry = starcal_ros.CameraGeometry(camera, [0, 0, 0.6, 0.8])
    >>> geometry.star_tracker_from_camera.apply([1, 0, 0]).round(2).tolist()
    [0.28, 0.96, 0.0]
    """

    camera: CameraModel
    star_tracker_from_camera_xyzw: Quaternion

    @property
    def star_tracker_from_camera(self) -> Rotation:
        """The alignment as a rotation."""
        from scipy.spatial.transform import Rotation  # half of the start of a short command

        return Rotation.from_quat(self.star_tracker_from_camera_xyzw)

    def icrf_from_camera(self, icrf_from_star_tracker_xyzw: Floats) -> Rotation:
        """Attitude of the camera for an attitude (4,) of the star tracker."""
        alignment = self.star_tracker_from_camera
        return type(alignment).from_quat(icrf_from_star_tracker_xyzw) * alignment


@dataclass(frozen=True)
class TemperatureTerms:
    """
    Change of camera and alignment with temperature; `estimation.problem` has the equations.

    Raises ValueError for another number of terms.

    Attributes
    ----------
    reference_degc : float
        Temperature at which camera and alignment of the calibration hold.
    focal_per_degc, focal_per_degc_sigma : tuple of 0 to 2 float
        a1 (1/degC) and a2 (1/degC^2), and their 1-sigma.
    alignment_rate_rad_per_degc, alignment_rate_rad_per_degc_sigma : tuple of 0 or 3 float
        Passive small rotation in the camera frame per degree, and its 1-sigma.
    note : str
        Requested terms that were left out, with the reason; may be empty.

    Examples
    --------
    >>> terms = TemperatureTerms(20.0, focal_per_degc=(4e-5,), focal_per_degc_sigma=(1e-6,))
    >>> round(2000.0 * terms.focal_per_degc[0] * 10.0, 3)  # px, of fx = 2000 px at 30 degC
    0.8
    """

    reference_degc: Annotated[float, Finite()]
    focal_per_degc: Annotated[tuple[float, ...], Finite(), Shape(('q',))] = ()
    focal_per_degc_sigma: Annotated[tuple[float, ...], Shape(('q',))] = ()
    alignment_rate_rad_per_degc: Annotated[tuple[float, ...], Finite(), Shape(('r',))] = ()
    alignment_rate_rad_per_degc_sigma: Annotated[tuple[float, ...], Shape(('r',))] = ()
    note: str = ''

    def __post_init__(self) -> None:
        """Check the number of terms."""
        axes, order = len(self.alignment_rate_rad_per_degc), len(self.focal_per_degc)
        if axes not in (0, 3):
            raise ValueError(f'alignment_rate_rad_per_degc: {axes} numbers, not 3 or none')
        if order > 2:
            raise ValueError(f'focal_per_degc: {order} numbers, at most 2 are allowed')


@dataclass(frozen=True, eq=False, repr=False)
class DetectorMaps(Record):
    """
    Precision of a calibration over the detector; v increases with the row.

    Attributes
    ----------
    stars : (coverage_rows, coverage_cols) int64
        Number of star observations used in each of equal cells of the detector.
    line_of_sight_sigma_arcsec : (map_rows, map_cols)
        1-sigma of the line of sight of a pixel in the star tracker frame, camera and alignment
        together, at a regular grid of pixels from corner to corner.
    shape_sigma_arcsec : (map_rows, map_cols)
        1-sigma of the camera alone, after the rotation common to all those pixels is removed.

    Examples
    --------
    >>> import starcal_ros
    >>> maps = starcal_ros.read_calibration('out').maps
    >>> maps.stars.shape, maps.shape_sigma_arcsec.shape  # rows, columns
    ((8, 10), (16, 20))
    """

    stars: Annotated[NDArray[np.int64], Shape(('coverage_rows', 'coverage_cols'))]
    line_of_sight_sigma_arcsec: Annotated[Floats, Shape(('map_rows', 'map_cols'))]
    shape_sigma_arcsec: Annotated[Floats, Shape(('map_rows', 'map_cols'))]


@dataclass(frozen=True, eq=False, repr=False)
class Correlation(Record):
    """
    Correlations (k, k) of the k named numbers that have an uncertainty.

    Camera parameters that were estimated or considered, focal terms, alignment angles and rate.

    >>> import starcal_ros
    >>> correlation = starcal_ros.read_calibration('out').correlation
    >>> k1, k2 = map(correlation.names.index, ('k1', 'k2'))
    >>> bool(correlation.matrix[k1, k2] < -0.5)
    True
    """

    names: Annotated[tuple[str, ...], Shape(('k',))]
    matrix: Annotated[Floats, Shape(('k', 'k'))]


@dataclass(frozen=True)
class GateCheck:
    """
    One check of the gate.

    ``option`` is the parameter that sets the limit: a lower limit where its name begins with
    ``min_``, else an upper limit.  ``found`` and ``limit`` are in ``unit``, empty for pure
    numbers.  A check without a number has an empty option and NaN for both.  ``passed`` is None
    and ``found`` NaN where it was not checked; ``note`` has the reason, or another for the result.

    >>> check = GateCheck('residual', 'max_residual_rms_px', 0.1518, 0.5, 'px', passed=True)
    >>> f'{check.name}: {check.found_text} of at most {check.limit_text}'
    'residual: 0.1518 px of at most 0.5 px'
    """

    name: str
    option: str
    found: float
    limit: float
    unit: str
    passed: bool | None
    note: str = ''

    @property
    def is_least(self) -> bool:
        """True if the limit is a lower limit."""
        return self.option.startswith('min_')

    @property
    def found_text(self) -> str:
        """The value found with its unit; empty where there is none."""
        if not self.option or self.passed is None:
            return ''
        # Thousandths of a small limit; digits behind them decide nothing.
        decimals = 4 if not 0 < self.limit < 0.1 else 3 - math.floor(math.log10(self.limit))
        return self._text(self.found, decimals)

    @property
    def limit_text(self) -> str:
        """The limit with its unit; empty where there is none."""
        return self._text(self.limit) if self.option else ''

    def _text(self, value: float, decimals: int = 15) -> str:
        if not math.isfinite(value):
            return 'not a finite number'
        least = 10.0**-decimals
        rounded = round(value, decimals) if abs(value) >= least else value
        number = significant(rounded, 4, least=least)
        return f'{number} {self.unit}' if self.unit else number


@dataclass(frozen=True)
class HeldTerm:
    """
    An unknown that is held or has a stated prior, with its estimate from the stars.

    ``assumed`` is the held or prior value, ``estimated`` that from the stars; ``sigma`` is the
    1-sigma of their difference if the assumption is true.  Both are NaN where the stars alone do
    not determine it.  ``evidence`` is the log evidence of the data without the prior less that
    with it: free unknowns also fit errors of the lens, which do not contradict a prior that
    explains the data nearly as well.  It is NaN where the distance alone counts.

    >>> round(HeldTerm('cx', assumed=319.5, estimated=320.1, sigma=0.3).significance, 6)
    2.0
    """

    name: str
    assumed: float
    estimated: float
    sigma: float
    evidence: float = math.nan

    @property
    def distance(self) -> float:
        """The difference over its sigma; NaN where it was not checked."""
        return abs(self.estimated - self.assumed) / self.sigma

    @property
    def significance(self) -> float:
        """
        The difference in sigmas, as far as the evidence allows; NaN where it was not checked.

        Where the evidence counts, twice its log is the square of as many sigmas.
        """
        if math.isnan(self.evidence):
            return self.distance
        return min(self.distance, math.sqrt(max(2.0 * self.evidence, 0.0)))


@dataclass(frozen=True)
class StatementCheck:
    """
    A check of a statement that needs no stars.

    ``passed`` is None where nothing else shows the stated value; ``note`` has what was compared,
    or why nothing was, and the remedy.

    >>> StatementCheck('velocity', True, 'the velocity is 7.61 km/s from that of the Earth').passed
    True
    """

    name: str
    passed: bool | None
    note: str


@dataclass(frozen=True)
class DetectorStep:
    """
    The most significant step between two parts of the detector, as caused by lost columns.

    Stars beyond ``place_px`` on the axis ``across`` (u or v) are displaced by ``size_px`` along
    the axis ``moved``; ``p_value`` accounts for the number of places tested.
    """

    across: str
    place_px: float
    moved: str
    size_px: float
    p_value: float


@dataclass(frozen=True)
class ResidualBin:
    """
    Residuals of a group of stars, each predicted from the other data.

    ``by`` names the quantity that defines the group.  Residuals of images predicted from other
    images are grouped by ``radius`` (px from the middle of the detector), ``magnitude`` or
    ``image`` (its number in order of time); sums over stars by ``star`` (its number of images),
    sums over cells of the detector by ``cell`` (px from the middle), sums over stars of like
    magnitude of an image by ``brightness``.  ``low`` and ``high`` are the limits of the group.
    ``normalised`` is the RMS of the residuals over their predicted sigma, 1 if the model and its
    sigmas are right, and ``sigma`` its 1-sigma.
    """

    by: str
    low: float
    high: float
    stars: Count
    normalised: float
    sigma: float


@dataclass(frozen=True)
class Amplitude:
    """
    An estimated amplitude of errors that the model does not describe.

    ``value`` is the 1-sigma of these errors in ``unit``; ``likelihood_ratio`` is twice the log
    likelihood ratio against an amplitude of zero.  The ratio is reported only.
    """

    name: str
    value: float
    unit: str
    likelihood_ratio: float


@dataclass(frozen=True)
class ModelChecks:
    """
    Deviations of the data from the model and its priors.

    ``field_rms_px`` and ``field_worst_px`` are RMS per axis and largest length of the residual
    field over the detector.  ``image_variation_px`` is the 1-sigma change of the camera between
    images at a corner, included in the covariance.  ``predictions`` are empty with fewer than four
    images; ``statements`` are the checks that need no stars.

    >>> import starcal_ros
    >>> checks = starcal_ros.read_calibration('out').model_checks
    >>> sorted(term.name for term in checks.held if term.significance < 3.0)[:2]
    ['cx', 'cy']
    >>> checks.step.across in 'uv', checks.amplitudes[0].unit, checks.predictions[0].by
    (True, 'px', 'radius')
    """

    field_rms_px: float
    field_worst_px: float
    held: tuple[HeldTerm, ...]
    step: DetectorStep
    image_variation_px: float
    amplitudes: tuple[Amplitude, ...] = ()
    predictions: tuple[ResidualBin, ...] = ()
    statements: tuple[StatementCheck, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class StarTrackerAlignment(Record):
    """
    Alignment of the camera to one of several star trackers.

    Attributes
    ----------
    frame : str
        Frame of the star tracker.
    images : int
        Number of images with an attitude from this star tracker; with 0 the mounting is the prior.
    star_tracker_from_camera_xyzw : (4,)
        Orientation of the camera in the frame of the star tracker.
    alignment_covariance_rad2 : (3, 3)
        Covariance of the passive small rotation of the camera, in the camera frame.
    first_from_star_tracker_xyzw : (4,)
        Orientation of the star tracker in the frame of the first one.
    mounting_covariance_rad2 : (3, 3)
        Covariance of a small rotation of the mounting about the axes of the camera; zero for the
        first star tracker.
    drift_arcsec_per_hour : tuple of 3 float
        Drift of the attitude against the stars, about the axes of the star tracker: the passive
        rotation from the true to the reported attitude, as in the residuals.
    drift_arcsec, drift_p_value : float
        Length of the drift over the time span of its images, and p-value of the hypothesis of no
        drift; NaN for fewer than four images.

    Examples
    --------
    >>> import numpy as np
    >>> zero, identity = np.zeros((3, 3)), np.array([0.0, 0.0, 0.0, 1.0])
    >>> second = StarTrackerAlignment(
    ...     'st_2', 12, identity, zero, identity, zero, (0.0, 0.0, 36.0), 18.0, 1e-4)
    >>> second.drift_arcsec / second.drift_arcsec_per_hour[2]  # hours from first to last image
    0.5
    """

    frame: str
    images: Count
    star_tracker_from_camera_xyzw: Quaternion
    alignment_covariance_rad2: Annotated[Floats, Finite(), Shape((3, 3))]
    first_from_star_tracker_xyzw: Quaternion
    mounting_covariance_rad2: Annotated[Floats, Finite(), Shape((3, 3))]
    drift_arcsec_per_hour: Annotated[tuple[float, ...], Shape((3,))]
    drift_arcsec: float
    drift_p_value: float


@dataclass(frozen=True)
class SigmaPart:
    """
    Contribution of one cause to the 1-sigma of lines of sight, RMS over the detector.

    Its square is the decrease of the variance if the cause were known exactly, or absent.
    Contributions of correlated causes overlap: their squares need not add up to the total.

    Attributes
    ----------
    cause : str
        `TOTAL` for all causes together.
    map_arcsec : float
        Of the camera alone, the common rotation removed.
    pointing_arcsec : float
        In the star tracker frame.
    assumption : str
        The value assumed or estimated for the cause.
    map_over_detector_arcsec : tuple of 63 float
        Of the camera alone at a grid of 9 columns and 7 rows of pixels from corner to corner, row
        by row; empty where it was not computed.

    Examples
    --------
    >>> import starcal_ros
    >>> total, *parts = starcal_ros.read_calibration('out').sigma_budget
    >>> total.cause, 'stars' in [part.cause for part in parts]
    ('total', True)
    """

    cause: str
    map_arcsec: float
    pointing_arcsec: float
    assumption: str
    map_over_detector_arcsec: tuple[float, ...] = ()


@dataclass(frozen=True)
class Statement:
    """
    A value of a data sheet that no option states, with the 1-sigma before and after stating it.

    ``scope`` is ``pointing``, lines of sight in the star tracker frame, or ``camera``, those of
    the camera alone, RMS over the detector; ``value`` is what the option would be set to, and
    ``cause`` the `SigmaPart` that it lowers, empty where not recorded.

    >>> str(Statement('star_tracker_slow_arcsec', '5', 'pointing', 77.0, 11.0))
    'state star_tracker_slow_arcsec: pointing (rms) 77″ becomes 11″ if it is 5'
    """

    option: str
    value: str
    scope: str
    before_arcsec: float
    after_arcsec: float
    cause: str = ''

    def removed_share(self, part: SigmaPart) -> float:
        """Share of the variance of its cause, a part of the budget, that stating it removes."""
        gone = part.pointing_arcsec if self.scope == 'pointing' else part.map_arcsec
        return (self.before_arcsec**2 - self.after_arcsec**2) / max(gone**2, 1e-300)

    @property
    def gain(self) -> str:
        """The sigmas in words."""
        before, after = (significant(s, 2) for s in (self.before_arcsec, self.after_arcsec))
        return f'{self.scope} (rms) {before}″ becomes {after}″ if it is {self.value}'

    def __str__(self) -> str:
        """Sentence for a user."""
        return f'state {self.option}: {self.gain}'


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Record):
    """
    One calibration with its covariance, statistics and provenance.

    Raises ValueError when the covariance does not fit the camera.

    Attributes
    ----------
    time_ns : int
        Stamp of the last image used.
    geometry : CameraGeometry
        The estimated camera and alignment.
    covariance : (p, p)
        Covariance of `parameter_names`: zero rows for held parameters; the alignment angles (rad)
        are passive small rotations in the camera frame.
    method : str
    estimated : tuple of str
        The camera parameters that were estimated.
    residual_rms_px : float
        Per axis, over the stars used.
    variance_factor : float
        chi^2 per degree of freedom with the centroid covariances as given.
    images_used, stars_used, stars_rejected : int
    images_refused : mapping
        Reason -> count.
    alignment_scatter_arcsec : float
        RMS per axis of the alignments of the single images around their mean; 0 for ``single``.
    star_tracker_sigma_arcsec : tuple of 3 float
        1-sigma about the axes of the star tracker, as assumed or as estimated.
    centroid_scale, centroid_floor_px : float
        The centroid covariances C were used as ``scale C + floor^2 I``.
    dropped_catalog_ids : tuple of int
        Stars that do not fit in several images, excluded from all.
    misfit_images_ns : tuple of int
        Stamps of images whose attitude does not fit, or that lost their stars.
    singular_values : tuple of float
        Singular values of the information matrix of the estimated parameters, scaled to a unit
        diagonal, in descending order.
    weakest_direction : str
        The parameters of the smallest singular value, in words.
    zero_skew_cost_px : float
        Largest pixel error of the zero-skew fit that ``camera_info`` carries.
    iterations, termination
        As reported by the solver.
    accepted, reasons
        The verdict of the gate.
    parent_frame, child_frame : str
        Names of the star tracker frame and of the camera frame.  The first is empty where the
        attitudes are those of the stars: there is no alignment.
    provenance : mapping of str to str
    temperature : TemperatureTerms or None
        None if no change with temperature was requested.
    maps : DetectorMaps or None
    correlation : Correlation or None
        None where not recorded.
    first_image_ns : int
        Stamp of the first image used.
    number : int
        Sequence number of the activation on its calibrator; 0 for a candidate.
    active_since_ns : int
        Time of the activation, or of a roll-back to it; 0 for a candidate.
    forced : bool
        Activated by request despite the gate.
    star_trackers : tuple of StarTrackerAlignment
        The star tracker of ``geometry``, then the others; empty if there is only one.
    gate : tuple of GateCheck
        The checks of the gate; empty where not recorded.
    sigma_budget : tuple of SigmaPart
        The total, then the causes; empty where not recorded.
    statements : tuple of Statement
        What to state to lower a sigma, the largest fall first.

    Examples
    --------
    >>> import starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> calibration.parameter_names[-3:], calibration.covariance.shape
    (('alignment_x', 'alignment_y', 'alignment_z'), (13, 13))
    >>> calibration.accepted, calibration.reasons, calibration.images_used
    (True, (), 10)
    >>> print(repr(calibration).splitlines()[0])  # of three; summary() has more
    Calibration of camera on star_tracker: accepted by the gate
    """

    time_ns: Stamp
    geometry: CameraGeometry
    covariance: Annotated[Floats, Shape(('p', 'p'))]
    method: str
    estimated: tuple[str, ...]
    residual_rms_px: float
    variance_factor: float
    images_used: Count
    images_refused: Mapping[str, Count]
    stars_used: Count
    stars_rejected: Count
    alignment_scatter_arcsec: float
    star_tracker_sigma_arcsec: Annotated[tuple[float, ...], Shape((3,))]
    centroid_scale: float
    centroid_floor_px: float
    dropped_catalog_ids: tuple[int, ...]
    misfit_images_ns: tuple[int, ...]
    singular_values: tuple[float, ...]
    weakest_direction: str
    zero_skew_cost_px: float
    iterations: Count
    termination: str
    accepted: bool
    reasons: tuple[str, ...]
    parent_frame: str
    child_frame: str
    provenance: Mapping[str, str]
    temperature: TemperatureTerms | None = None
    maps: DetectorMaps | None = None
    correlation: Correlation | None = None
    first_image_ns: Stamp = 0
    number: Count = 0
    active_since_ns: Stamp = 0
    forced: bool = False
    star_trackers: tuple[StarTrackerAlignment, ...] = ()
    model_checks: ModelChecks | None = None
    field: ResidualField | None = None
    gate: tuple[GateCheck, ...] = ()
    sigma_budget: tuple[SigmaPart, ...] = ()
    statements: tuple[Statement, ...] = ()

    def __post_init__(self) -> None:
        """Check the size of the covariance."""
        p = len(self.parameter_names)
        if self.covariance.shape != (p, p):
            sides = ' x '.join(map(str, self.covariance.shape))
            raise ValueError(f'covariance: {sides} numbers, not {p} x {p}')
        if self.field is not None and self.geometry.camera.field is None:
            # Files and messages hold the field beside the camera, with its covariance.
            camera = self.geometry.camera
            detector_field = self.field.on(camera.width, camera.height)
            count = p + detector_field.coefficients.size
            if self.field.rows != count:
                raise ValueError(f'field: covariance of {self.field.rows} rows, not {count}')
            camera = replace(camera, field=detector_field)
            geometry = replace(self.geometry, camera=camera)
            object.__setattr__(self, 'geometry', geometry)

    def __repr__(self) -> str:
        """Return verdict, images, residual and precision in three lines."""
        camera, frame = self.geometry.camera, f' on {self.parent_frame}' * self.has_alignment
        total = next((part for part in self.sigma_budget if part.cause == TOTAL), None)
        sigma = 'not recorded'
        if total is not None:
            pointing = f', with alignment {significant(total.pointing_arcsec, 2)}″'
            sigma = f'camera alone {significant(total.map_arcsec, 2)}″' + pointing * bool(frame)
            sigma += ' rms over the detector'
        return (
            f'Calibration of {self.child_frame}{frame}:'
            f' {"accepted" if self.accepted else "refused"} by the gate\n'
            f'  {camera.model}, {camera.width} x {camera.height} px; {self.stars_used} stars in'
            f' {self.images_used} images, residual {significant(self.residual_rms_px, 3)} px rms'
            f' per axis\n  1-sigma of lines of sight: {sigma}'
        )

    def summary(self) -> str:
        """Text with the verdict, its reasons, and each parameter with its 1-sigma."""
        lines = [repr(self), *(f'  refused: {reason}' for reason in self.reasons)]
        parameters, sigma = self.geometry.camera.parameters.tolist(), self.sigma.tolist()
        for name, value, one in zip(self.parameter_names, parameters, sigma, strict=False):
            known = f'1-sigma {significant(one, 2)}' if one > 0 else 'held'
            lines.append(f'  {name:12} {to_sigma(value, one):>12}  {known}')
        for name, one in zip(ALIGNMENT_NAMES, sigma[-3:] * self.has_alignment, strict=False):
            known = f'1-sigma {significant(one / ARCSECOND_RAD, 2)}″'
            lines.append(f'  {name:25}  {known}')
        return '\n'.join(lines)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the rows of the covariance: camera parameters, then alignment angles."""
        return self.geometry.camera.parameter_names + ALIGNMENT_NAMES

    @property
    def has_alignment(self) -> bool:
        """False where the attitudes are those of the stars: ``parent_frame`` is empty then."""
        return bool(self.parent_frame)

    @property
    def map_covariance(self) -> MapCovariance:
        """Covariance of lines of sight, by `parameter_names` and the coefficients of a field."""
        if self.field is None:
            return MapCovariance(self.covariance)
        return MapCovariance(self.field.covariance, self.field.unresolved_px)

    @property
    def sigma(self) -> Floats:
        """1-sigma (p,) of `parameter_names`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Activation:
    """
    A calibration was activated, for the first time or by a roll-back.

    ``event`` counts activations; ``before`` is the event that a roll-back of this one returns to,
    0 for none.  The calibration is active until the next event.  ``origin`` is a unique name of
    the event, which it keeps where two histories are joined and it gets another number.
    """

    event: int
    before: int
    calibration: Calibration
    origin: str = field(default_factory=lambda: secrets.token_hex(8))


_MOST = 1e15  # largest camera parameter: its cube must be finite
_UNIT_TOLERANCE = 1e-6  # rounded decimals change the norm of a quaternion by less


def check_calibration(calibration: Calibration) -> None:
    """
    Check the geometry of a calibration from a file or a message.

    The camera of a refused calibration may be implausible, as long as a report can show it.

    Raises ValueError naming the field and its value.
    """
    if calibration.accepted or calibration.forced:
        check_plausible(calibration.geometry.camera)
    check_drawable(calibration.geometry)


def check_drawable(geometry: CameraGeometry) -> None:
    """Raise ValueError for a geometry that a report cannot show, with the field and value."""
    camera = geometry.camera
    largest, shortest_px = np.abs(camera.parameters).max(), camera.parameters[[0, 2]].min()
    if largest > _MOST:
        raise ValueError(f'parameters: {largest:.6g} is over {_MOST:g}')
    if shortest_px < 1.0 / _MOST:
        raise ValueError(f'fx, fy: {shortest_px:.6g} px is under {1.0 / _MOST:g} px')
    rotation = geometry.star_tracker_from_camera_xyzw
    if not abs(np.linalg.norm(rotation) - 1.0) < _UNIT_TOLERANCE:
        raise ValueError(f'alignment.rotation: {rotation.tolist()} is not a unit quaternion')
