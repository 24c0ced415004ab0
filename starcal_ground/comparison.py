# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Comparison of two calibrations: parameters, alignment and lines of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from starcal_ros.arrays import Floats, Indices
from starcal_ros.assessment.lookup import GRID, grid_lines_of_sight, line_of_sight_table, movement
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.record_fields import json_object
from starcal_ros.records import Calibration, CameraGeometry
from starcal_ros.text import counted

_SINGULAR = 1e-12  # smaller eigenvalues of a correlation matrix are rounding errors


@dataclass(frozen=True)
class ChiSquared:
    """A squared Mahalanobis distance and its degrees of freedom; both 0 if nothing is compared."""

    value: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Probability that noise alone gives as large a value; 1 without degrees of freedom."""
        n = self.degrees_of_freedom
        return float(chdtrc(n, self.value)) if n else 1.0


def chi_squared(difference: Floats, covariance: Floats) -> ChiSquared:
    """
    Squared length of a difference (k,) in the metric of its covariance (k, k) (Mahalanobis).

    Rows without a finite, positive variance are left out; directions in which the covariance is
    singular do not count as degrees of freedom.
    """
    known = np.isfinite(covariance).all(axis=1) & (np.diag(covariance) > 0)
    if not known.any():
        return ChiSquared(0.0, 0)
    difference, covariance = difference[known], covariance[np.ix_(known, known)]
    # Scaled to a unit diagonal first: fx and k3 differ by many powers of ten.
    sigma = np.sqrt(np.diag(covariance))
    scaled, correlation = difference / sigma, covariance / np.outer(sigma, sigma)
    inverse = np.linalg.pinv(correlation, rcond=_SINGULAR, hermitian=True)
    rank = int(np.linalg.matrix_rank(correlation, tol=_SINGULAR, hermitian=True))
    return ChiSquared(float(scaled @ inverse @ scaled), rank)


@dataclass(frozen=True)
class DifferenceMap:
    """
    Movement of the lines of sight of a grid of pixels, in the camera frame of A.

    ``length_px`` (rows, columns) is the angle in units of a pixel at the centre, as in the gate;
    ``difference_px`` (rows, columns, 2) is its part along u and v; ``sigmas`` (rows, columns) is
    the length in 1-sigma of both calibrations, NaN where nothing was estimated.
    """

    difference_px: Floats
    length_px: Floats
    sigmas: Floats

    @property
    def worst_and_rms_px(self) -> tuple[float, float]:
        """Largest length and its root mean square."""
        return float(self.length_px.max()), float(np.sqrt(np.mean(self.length_px**2)))

    @property
    def worst_and_rms_sigmas(self) -> tuple[float, float]:
        """The same of the lengths in their sigmas; NaN where nothing was estimated."""
        known = self.sigmas[np.isfinite(self.sigmas)]
        if not known.size:
            return math.nan, math.nan
        return float(known.max()), float(np.sqrt(np.mean(known**2)))


@dataclass(frozen=True)
class Comparison:
    """
    Calibration B against A.

    Attributes
    ----------
    difference, sigma : (p,)
        B less A of `Calibration.parameter_names`, and its 1-sigma if their errors are
        independent; (0,) for two lens models.  The alignment angles (rad) are passive small
        rotations in the camera frame.
    rotation_rad : float
        The rotation common to all lines of sight.
    before, after : DifferenceMap
        Of the lines of sight in the star tracker frame, and with the common rotation removed.
    total : ChiSquared
        Of all differences together, without the alignment if not `is_aligned`; no degrees of
        freedom where nothing was estimated.
    notes : tuple of str
        Limitations of the sigmas.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import starcal_ground, starcal_ros
    >>> a = starcal_ros.read_calibration('out')
    >>> longer = a.geometry.camera.replace(fx=a.geometry.camera.camera_matrix[0, 0] + 0.5)
    >>> b = replace(a, geometry=replace(a.geometry, camera=longer))
    >>> comparison = starcal_ground.compare(a, b)
    >>> print(comparison.difference[0].round(3), comparison.after.length_px.shape)
    0.5 (25, 25)
    """

    a: Calibration
    b: Calibration
    difference: Floats
    sigma: Floats
    rotation_rad: float
    before: DifferenceMap
    after: DifferenceMap
    total: ChiSquared
    notes: tuple[str, ...]

    @property
    def is_aligned(self) -> bool:
        """True if both have an alignment: else only their cameras are compared."""
        return self.a.has_alignment and self.b.has_alignment

    @property
    def sigmas(self) -> Floats:
        """The differences in their sigma, (p,); NaN where a parameter was held in both."""
        return _ratio(self.difference, self.sigma)


def compare(a: Calibration, b: Calibration, stamps_ns: Sequence[Indices] = ()) -> Comparison:
    """
    Difference of B from A.

    ``stamps_ns`` are the times of the images of A and of B (`Residuals.image_time_ns`), which show
    whether both use the same images; without them the spans of their times have to.  Of two lens
    models only the lines of sight are compared.  Raises ProductError when the cameras differ in
    size, or a pixel has no line of sight.

    >>> import starcal_ground, starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> same = starcal_ground.compare(calibration, calibration)
    >>> same.total.value, same.total.degrees_of_freedom
    (0.0, 13)
    """
    camera_a, camera_b = a.geometry.camera, b.geometry.camera
    if (camera_a.width, camera_a.height) != (camera_b.width, camera_b.height):
        raise ProductError(
            f'A is of a camera of {camera_a.width} x {camera_a.height}, '
            f'B of one of {camera_b.width} x {camera_b.height}: they cannot be compared'
        )
    difference: Floats = np.empty(0)
    covariance: Floats = np.empty((0, 0))
    if camera_a.has_lens(camera_b.model):
        difference = parameter_difference(b.geometry, a.geometry)
        covariance = a.covariance + b.covariance
    sigma = np.sqrt(np.diag(covariance))
    old, new = (_sound_lines_of_sight(calibration.geometry) for calibration in (a, b))
    rotation, _ = Rotation.align_vectors(new, old)
    of_a, of_b = (
        line_of_sight_table(camera, c.map_covariance, pixel_grid(camera, GRID, GRID))
        for c, camera in ((a, camera_a), (b, camera_b))
    )
    sight_sigma_rad = np.hypot(of_a.sigma_arcsec, of_b.sigma_arcsec) * ARCSECOND_RAD
    shape_sigma_rad = np.hypot(of_a.shape_sigma_arcsec, of_b.shape_sigma_arcsec) * ARCSECOND_RAD
    compared = slice(None if a.has_alignment and b.has_alignment else -3)
    return Comparison(
        a=a,
        b=b,
        difference=difference,
        sigma=sigma,
        rotation_rad=float(rotation.magnitude()),
        before=_map(new - old, a.geometry, sight_sigma_rad),
        after=_map(new - rotation.apply(old), a.geometry, shape_sigma_rad),
        total=chi_squared(difference[compared], covariance[compared, compared]),
        notes=(*_shared(a, b, stamps_ns), *_notes(a, b, difference, sigma)),
    )


def truth_like(calibration: Calibration, geometry: CameraGeometry) -> Calibration:
    """The truth behind a calibration as one without sigma, to compare it with."""
    none = np.zeros((len(geometry.camera.parameters) + 3,) * 2)
    return replace(
        calibration,
        geometry=geometry,
        covariance=none,
        field=None,
        accepted=True,
        reasons=(),
        images_used=0,
        provenance={},
    )


def parameter_difference(a: CameraGeometry, b: CameraGeometry) -> Floats:
    """Parameters of a less those of b, (p,): camera, then `alignment_difference_rad`."""
    of_camera = a.camera.parameters - b.camera.parameters
    return np.concatenate([of_camera, alignment_difference_rad(a, b)])


def alignment_difference_rad(a: CameraGeometry, b: CameraGeometry) -> Floats:
    """The passive small rotation (3,) of the camera frame that takes alignment b to a."""
    # a_from_b = exp(-[dtheta x]), so b_from_a has dtheta as its rotation vector.
    b_from_a = b.star_tracker_from_camera.inv() * a.star_tracker_from_camera
    return np.asarray(b_from_a.as_rotvec())


def _sound_lines_of_sight(geometry: CameraGeometry) -> Floats:
    """Lines of sight of the grid, (GRID^2, 3), star tracker frame."""
    directions = grid_lines_of_sight(geometry, GRID, GRID)
    if not np.isfinite(directions).all():
        raise ProductError(
            'a calibration has pixels without a line of sight: its distortion folds'
        )
    return directions


def _map(moved: Floats, frame: CameraGeometry, sigma_rad: Floats) -> DifferenceMap:
    """Map of differences (GRID^2, 3) of unit vectors, star tracker frame; sigmas (GRID^2,)."""
    in_camera = frame.star_tracker_from_camera.inv().apply(moved).reshape(GRID, GRID, 3)
    length_rad = np.linalg.norm(in_camera, axis=-1)
    focal_px: float = frame.camera.parameters[0]
    return DifferenceMap(
        difference_px=in_camera[..., :2] * focal_px,
        length_px=length_rad * focal_px,
        sigmas=_ratio(length_rad, sigma_rad.reshape(GRID, GRID)),
    )


def _ratio(values: Floats, sigma: Floats) -> Floats:
    return np.asarray(
        np.divide(values, sigma, out=np.full(np.shape(values), np.nan), where=sigma > 0)
    )


def _shared(a: Calibration, b: Calibration, stamps_ns: Sequence[Indices]) -> list[str]:
    """
    Note that A and B use the same stars; empty if they do not.

    Images of one camera are the same if their stamps are, whatever prior or options read them.
    """
    first_ns, last_ns = max(a.first_image_ns, b.first_image_ns), min(a.time_ns, b.time_ns)
    count = len(np.intersect1d(stamps_ns[0], stamps_ns[1])) if len(stamps_ns) == 2 else None
    if count == 0 or first_ns > last_ns or not (a.images_used and b.images_used):
        return []
    shared = f'share {counted(count, "image")}' if count else 'are of the same time'
    correlated = 'errors by the same stars are correlated'
    return [f'A and B {shared}: {correlated}, so the true sigma of a difference is smaller']


def _notes(a: Calibration, b: Calibration, difference: Floats, sigma: Floats) -> tuple[str, ...]:
    notes = []
    lens_a, lens_b = a.geometry.camera.model, b.geometry.camera.model
    if lens_a != lens_b:
        notes.append(
            f'A has the lens model {lens_a}, B {lens_b}: their parameters mean different cameras,'
            ' so the lines of sight alone are compared'
        )
    for name, calibration in (('A', a), ('B', b)):
        if not calibration.accepted:
            notes.append(f'the gate refused {name}: {"; ".join(calibration.reasons)}')
    held = [
        name
        for name, moved, error in zip(
            a.geometry.camera.parameter_names, difference, sigma, strict=False
        )
        if moved and not error
    ]
    if held:
        notes.append(f'held in both, at different values: {", ".join(held)}')
    if (a.parent_frame, a.child_frame) != (b.parent_frame, b.child_frame):
        notes.append(
            f'the frames have other names: {a.parent_frame}, {a.child_frame} in A, '
            f'{b.parent_frame}, {b.child_frame} in B'
        )
    degc = [c.temperature.reference_degc for c in (a, b) if c.temperature is not None]
    if len(degc) == 1 or len(set(degc)) > 1:
        notes.append('they hold at different temperatures (reference_degc)')
    return tuple(notes)


def content(comparison: Comparison) -> dict[str, object]:
    """A comparison as a JSON object; what is not finite, or of no alignment, is null."""

    def of_map(moved: DifferenceMap) -> dict[str, object]:
        names = ('worst_px', 'rms_px', 'worst_sigmas', 'rms_sigmas')
        numbers = (*moved.worst_and_rms_px, *moved.worst_and_rms_sigmas)
        lengths = dict(zip(names, numbers, strict=True))
        return {**lengths, 'difference_px': moved.difference_px, 'sigmas': moved.sigmas}

    total, aligned = comparison.total, comparison.is_aligned
    names = comparison.a.parameter_names if comparison.difference.size else ()
    angles = comparison.difference[-3:] / ARCSECOND_RAD
    values = {
        'parameter_names': names,
        'a': comparison.a.geometry.camera.parameters,
        'b': comparison.b.geometry.camera.parameters,
        'difference': comparison.difference,
        'sigma': comparison.sigma,
        'sigmas': comparison.sigmas,
        'alignment_arcsec': angles if aligned and angles.size else None,
        'common_rotation_arcsec': comparison.rotation_rad / ARCSECOND_RAD if aligned else None,
        'lines_of_sight': of_map(comparison.before) if aligned else None,
        'without_common_rotation': of_map(comparison.after),
        'chi2': total.value if total.degrees_of_freedom else None,
        'degrees_of_freedom': total.degrees_of_freedom,
        'p_value': total.p_value if total.degrees_of_freedom else None,
        'accepted': [comparison.a.accepted, comparison.b.accepted],
        'notes': comparison.notes,
    }
    return json_object(values)


def map_error_px(found: CameraModel, true: CameraModel) -> float:
    """
    RMS difference over the detector of the lines of sight of two cameras, px at the focal length.

    The best common rotation is removed, because a calibration assigns it to the alignment.
    Infinite if a pixel has no line of sight, where the distortion folds.
    """
    unturned = np.array([0.0, 0.0, 0.0, 1.0])
    before, after = CameraGeometry(found, unturned), CameraGeometry(true, unturned)
    _, left_px = movement(before, after, GRID, GRID)
    return float(np.sqrt(np.mean(left_px**2)))
