"""Two calibrations beside each other: parameters, alignment, and the lines of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.assessment.agreement import alignment_difference_rad, lines_of_sight
from starcal_ros.assessment.observability import line_of_sight_sigma_arcsec, map_sigma_px
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.records import Calibration, CALIBRATION_PARAMETER_NAMES, CameraGeometry

GRID = 25  # the columns and rows of `map_sigma_px`


@dataclass(frozen=True)
class DifferenceMap:
    """
    How far the lines of sight of a grid of pixels moved, in the camera frame of A.

    ``length_px`` (rows, columns) is the angle in units of a pixel at the centre, as the gate has
    it; ``difference_px`` (rows, columns, 2) is its part along u and v; ``sigmas`` (rows, columns)
    is the length in 1-sigma of both calibrations, NaN where nothing was estimated.
    """

    difference_px: Floats
    length_px: Floats
    sigmas: Floats


@dataclass(frozen=True)
class Comparison:
    """
    Calibration B against A.

    Attributes
    ----------
    difference, sigma : (13,)
        B less A of `CALIBRATION_PARAMETER_NAMES`, and its 1-sigma if their errors are
        independent.  The alignment angles (rad) are passive small rotations in the camera frame.
    turn_rad : float
        The rotation common to all lines of sight.
    before, after : DifferenceMap
        Of the lines of sight in the star tracker frame, and with the common turn taken off.
    chi2, degrees, chance : float, int, float
        Of all differences together, and the chance of one as large where only noise differs; NaN
        where nothing was estimated.
    notes : tuple of str
        What to know before believing the sigmas.
    """

    a: Calibration
    b: Calibration
    difference: Floats
    sigma: Floats
    turn_rad: float
    before: DifferenceMap
    after: DifferenceMap
    chi2: float
    degrees: int
    chance: float
    notes: tuple[str, ...]

    @property
    def sigmas(self) -> Floats:
        """The differences in their sigma, (13,); NaN where a parameter was held in both."""
        return _ratio(self.difference, self.sigma)


def compare(a: Calibration, b: Calibration) -> Comparison:
    """
    How far B is from A.

    Raises
    ------
    ProductError
        When they are of cameras of different size, or a pixel has no line of sight.
    """
    camera_a, camera_b = a.geometry.camera, b.geometry.camera
    if (camera_a.width, camera_a.height) != (camera_b.width, camera_b.height):
        raise ProductError(
            f'A is of a camera of {camera_a.width} x {camera_a.height}, '
            f'B of one of {camera_b.width} x {camera_b.height}: they cannot be compared'
        )
    difference = np.concatenate(
        [
            camera_b.parameters - camera_a.parameters,
            alignment_difference_rad(b.geometry, a.geometry),
        ]
    )
    sigma = np.sqrt(np.diag(a.covariance) + np.diag(b.covariance))
    old, new = (_sound_lines_of_sight(calibration.geometry) for calibration in (a, b))
    turn, _ = Rotation.align_vectors(new, old)
    sight_sigma_rad = _both(
        *(
            line_of_sight_sigma_arcsec(c.geometry.camera, c.covariance, GRID, GRID) * ARCSECOND_RAD
            for c in (a, b)
        )
    )
    shape_sigma_px = _both(*(map_sigma_px(c.geometry.camera, c.covariance, GRID) for c in (a, b)))
    shape_sigma_rad = shape_sigma_px / camera_a.parameters[0]
    degrees, total = _chi2(difference, a.covariance + b.covariance)
    return Comparison(
        a=a,
        b=b,
        difference=difference,
        sigma=sigma,
        turn_rad=float(turn.magnitude()),
        before=_map(new - old, a.geometry, sight_sigma_rad),
        after=_map(new - turn.apply(old), a.geometry, shape_sigma_rad),
        chi2=total,
        degrees=degrees,
        chance=float(chdtrc(degrees, total)) if degrees else float('nan'),
        notes=_notes(a, b, difference, sigma),
    )


def _sound_lines_of_sight(geometry: CameraGeometry) -> Floats:
    """Of the grid, (GRID^2, 3), star tracker frame."""
    directions = lines_of_sight(geometry, GRID, GRID)
    if not np.isfinite(directions).all():
        raise ProductError(
            'a calibration has pixels without a line of sight: its distortion folds'
        )
    return directions


def _both(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.hypot(a, b).reshape(GRID, GRID))


def _map(moved: Floats, frame: CameraGeometry, sigma_rad: Floats) -> DifferenceMap:
    """Of (GRID^2, 3) differences of unit vectors, star tracker frame; pixels as the gate's."""
    camera_from_star_tracker = Rotation.from_quat(frame.star_tracker_from_camera_xyzw).inv()
    in_camera = camera_from_star_tracker.apply(moved).reshape(GRID, GRID, 3)
    length_rad = np.linalg.norm(in_camera, axis=-1)
    focal_px: float = frame.camera.parameters[0]
    return DifferenceMap(
        difference_px=in_camera[..., :2] * focal_px,
        length_px=length_rad * focal_px,
        sigmas=_ratio(length_rad, sigma_rad),
    )


def _ratio(values: Floats, sigma: Floats) -> Floats:
    return np.asarray(
        np.divide(values, sigma, out=np.full(np.shape(values), np.nan), where=sigma > 0)
    )


def _chi2(difference: Floats, covariance: Floats) -> tuple[int, float]:
    """Degrees of freedom, and the squared length of a difference in its covariance."""
    known = np.isfinite(covariance).all(axis=1) & (np.diag(covariance) > 0)
    if not known.any():
        return 0, float('nan')
    sigma = np.sqrt(np.diag(covariance)[known])
    # Scaled to a unit diagonal first: fx and k3 differ by many powers of ten.
    values, vectors = np.linalg.eigh(covariance[np.ix_(known, known)] / np.outer(sigma, sigma))
    whole = values > 1e-12
    parts = vectors[:, whole].T @ (difference[known] / sigma)
    return int(whole.sum()), float(np.sum(parts**2 / values[whole]))


def _notes(a: Calibration, b: Calibration, difference: Floats, sigma: Floats) -> tuple[str, ...]:
    notes = []
    for name, calibration in (('A', a), ('B', b)):
        if not calibration.accepted:
            notes.append(f'the gate refused {name}: {"; ".join(calibration.reasons)}')
    same = 'observations_sha256'
    if a.provenance.get(same) and a.provenance.get(same) == b.provenance.get(same):
        notes.append(
            'A and B are from the same stars: their errors are alike, so the true sigma of a '
            'difference is smaller'
        )
    held = [
        name
        for name, moved, error in zip(PARAMETER_NAMES, difference[:10], sigma[:10], strict=True)
        if moved and not error
    ]
    if held:
        notes.append(f'held in both, at different values: {", ".join(held)}')
    if (a.parent_frame, a.child_frame) != (b.parent_frame, b.child_frame):
        notes.append(
            f'the frames have other names: {a.parent_frame}, {a.child_frame} in A, '
            f'{b.parent_frame}, {b.child_frame} in B'
        )
    degc = [c.thermal.reference_degc for c in (a, b) if c.thermal is not None]
    if len(degc) == 1 or len(set(degc)) > 1:
        notes.append('they hold at different temperatures (reference_degc)')
    return tuple(notes)


def content(comparison: Comparison) -> dict[str, object]:
    """A comparison as a JSON object; a number that is not finite is null."""

    def plain(values: Floats) -> object:
        return np.where(np.isfinite(values), values.astype(object), None).tolist()  # type: ignore[call-overload]

    def of_map(found: DifferenceMap) -> dict[str, object]:
        length_px = found.length_px
        known = found.sigmas[np.isfinite(found.sigmas)]
        return {
            'worst_px': float(length_px.max()),
            'rms_px': float(np.sqrt(np.mean(length_px**2))),
            'worst_sigmas': float(known.max()) if known.size else None,
            'rms_sigmas': float(np.sqrt(np.mean(known**2))) if known.size else None,
            'difference_px': plain(found.difference_px),
            'sigmas': plain(found.sigmas),
        }

    return {
        'parameter_names': list(CALIBRATION_PARAMETER_NAMES),
        'a': plain(comparison.a.geometry.camera.parameters),
        'b': plain(comparison.b.geometry.camera.parameters),
        'difference': plain(comparison.difference),
        'sigma': plain(comparison.sigma),
        'sigmas': plain(comparison.sigmas),
        'alignment_arcsec': plain(comparison.difference[10:] / ARCSECOND_RAD),
        'common_turn_arcsec': comparison.turn_rad / ARCSECOND_RAD,
        'lines_of_sight': of_map(comparison.before),
        'without_common_turn': of_map(comparison.after),
        'chi2': comparison.chi2 if comparison.degrees else None,
        'degrees_of_freedom': comparison.degrees,
        'chance': comparison.chance if comparison.degrees else None,
        'accepted': [comparison.a.accepted, comparison.b.accepted],
        'notes': list(comparison.notes),
    }
