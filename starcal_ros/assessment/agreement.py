"""How far two calibrations differ: over the detector, and in the sigmas that they report."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.camera import line_of_sight, PARAMETER_NAMES, pixel_grid
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import CalibrationOptions, estimate_calibration
from starcal_ros.records import CameraGeometry, Ensemble

FEWEST_IMAGES = 6  # of an ensemble that can be cut in two: three tell a scatter
FEWEST_STARS = 100  # of a half: with fewer, its sigmas are too uncertain to judge by


@dataclass(frozen=True)
class Difference:
    """
    Between two calibrations of the same pixels.

    Attributes
    ----------
    turn_rad : float
        The rotation common to all lines of sight, in the star tracker frame.
    shape_px : float
        The largest movement of a line of sight that is left, px at the focal length.  Both are
        infinite where a pixel has no line of sight any more.
    shape_chi2, shape_freedom : float, int
        Squared length of the difference of the camera parameters that both have estimated in the
        metric of both covariances, and how many they are; 0 for none.
    chi2, freedom : float, int
        The same with the three angles of the alignment.
    """

    turn_rad: float
    shape_px: float
    shape_chi2: float
    shape_freedom: int
    chi2: float
    freedom: int

    @property
    def rms_sigma(self) -> float:
        """The difference in sigmas, RMS over what was estimated: about 1 by chance."""
        return math.sqrt(self.chi2 / self.freedom) if self.freedom else 0.0

    @property
    def chance(self) -> float:
        """How often chance alone makes two calibrations of one camera differ as much."""
        return float(chdtrc(self.freedom, self.chi2)) if self.freedom else 1.0

    @property
    def shape_chance(self) -> float:
        """The same of the cameras alone."""
        return float(chdtrc(self.shape_freedom, self.shape_chi2)) if self.shape_freedom else 1.0


def lines_of_sight(geometry: CameraGeometry, columns: int, rows: int) -> Floats:
    """
    Of a grid of pixels in the star tracker frame, (columns * rows, 3), row by row.

    NaN where a pixel has no line of sight.
    """
    in_camera = line_of_sight(geometry.camera, pixel_grid(geometry.camera, columns, rows))
    star_tracker_from_camera = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw)
    return np.asarray(star_tracker_from_camera.apply(in_camera))


def movement(
    before: CameraGeometry, after: CameraGeometry, columns: int = 15, rows: int = 12
) -> tuple[float, Floats]:
    """
    How far the lines of sight of the pixels of a camera moved in the star tracker frame.

    Returns
    -------
    turn_rad : float
        The rotation common to all pixels.
    left_px : (columns * rows,)
        The movement that is left at a grid of pixels, in pixels of the middle.  Both are infinite
        where a pixel has no line of sight any more.
    """
    old, new = (lines_of_sight(geometry, columns, rows) for geometry in (before, after))
    if not (np.isfinite(old).all() and np.isfinite(new).all()):
        return np.inf, np.full(len(old), np.inf)
    turn, _ = Rotation.align_vectors(new, old)
    left_rad = np.linalg.norm(new - turn.apply(old), axis=1)
    return float(turn.magnitude()), left_rad * after.camera.parameters[0]


def alignment_difference_rad(a: CameraGeometry, b: CameraGeometry) -> Floats:
    """The passive small rotation (3,) of the camera frame that takes alignment b to a."""
    star_tracker_from_a = Rotation.from_quat(a.star_tracker_from_camera_xyzw)
    star_tracker_from_b = Rotation.from_quat(b.star_tracker_from_camera_xyzw)
    # a_from_b = exp(-[dtheta x]), so b_from_a has dtheta as its rotation vector.
    return np.asarray((star_tracker_from_b.inv() * star_tracker_from_a).as_rotvec())


def difference(
    before: CameraGeometry,
    before_covariance: Floats,
    after: CameraGeometry,
    after_covariance: Floats,
    estimated: tuple[str, ...],
) -> Difference:
    """
    Difference of two calibrations; ``estimated`` are the camera parameters that both estimate.

    The covariances (13, 13) are taken as independent.  Of two ensembles that share images, the
    difference is less than they say.
    """
    turn_rad, left_px = movement(before, after)
    turned_rad = alignment_difference_rad(after, before)
    moves = np.concatenate([after.camera.parameters - before.camera.parameters, turned_rad])
    covariance = before_covariance + after_covariance
    camera = [PARAMETER_NAMES.index(name) for name in estimated]
    of_camera, of_all = (
        _squared_sigmas(moves[rows], covariance[np.ix_(rows, rows)])
        for rows in (camera, [*camera, 10, 11, 12])
    )
    return Difference(turn_rad, float(left_px.max()), *of_camera, *of_all)


def _squared_sigmas(moves: Floats, covariance: Floats) -> tuple[float, int]:
    """Squared length in the metric of a covariance, and its degrees of freedom."""
    scale = np.sqrt(np.diag(covariance))
    if not len(moves) or not (np.isfinite(scale).all() and (scale > 0).all()):
        return 0.0, 0
    scaled = moves / scale
    correlation = covariance / np.outer(scale, scale)
    return float(scaled @ np.linalg.pinv(correlation, hermitian=True) @ scaled), len(moves)


def halves(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Difference | str:
    """
    Difference of the calibrations of the earlier and of the later half of the images.

    What drifts or jumps while an ensemble is collected shows here: halves that are interleaved
    would share it.  In words, why there is none: with too few images, where a half does not
    determine what is to be estimated, or where a change with temperature is, since the halves are
    of other temperatures.
    """
    images = sorted(ensemble.images, key=lambda image: image.time_ns)
    if len(images) < FEWEST_IMAGES:
        return f'{len(images)} images, {FEWEST_IMAGES} make two halves'
    if options.focal_temperature_order or options.alignment_temperature:
        return 'the halves are of other temperatures'
    options = dataclasses.replace(options, min_images=2, min_stars=FEWEST_STARS)
    middle = len(images) // 2
    try:
        first, second = (
            estimate_calibration(Ensemble(tuple(part)), prior, options)
            for part in (images[:middle], images[middle:])
        )
    except TooFewObservations as error:
        return f'a half alone cannot be solved: {error}'
    return difference(
        first.geometry, first.covariance, second.geometry, second.covariance, options.estimate
    )
