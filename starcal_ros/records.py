"""
The frozen records that pass between the stages: images -> observations -> calibration.

Arrays in records are never changed after construction.
"""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from starcal_ros.camera import CameraModel, PARAMETER_NAMES

Floats = NDArray[np.float64]

ALIGNMENT_NAMES = ('alignment_x', 'alignment_y', 'alignment_z')
CALIBRATION_PARAMETER_NAMES = PARAMETER_NAMES + ALIGNMENT_NAMES

IMAGE_REFUSALS: Mapping[str, str] = {
    'bad_encoding': 'the pixel encoding is not one of mono8, mono16, 8UC1, 16UC1',
    'bad_layout': 'size, row step and data of the image message do not fit each other',
    'wrong_size': 'the image is not of the size of the prior camera',
    'bad_attitude': 'the attitude about the image is not finite or not of unit length',
    'no_attitude': 'no attitude sample on both sides of the image',
    'attitude_gap': 'the attitude samples about the image are too far apart',
    'out_of_order': 'the image is stamped before, or at, one already taken',
    'duplicate': 'the ensemble holds an image of the same stamp (said by the calibrator)',
    'overexposed': 'too large a part of the image is saturated',
    'blank': 'every pixel has the same value',
    'frozen': 'the pixels are those of an earlier image with another stamp',
    'incomplete': (
        'a part of the image is constant, repeats itself, is shifted or is of an earlier image'
    ),
    'glare': 'the background bends too much over most of the image to be subtracted',
    'no_stars': 'too few star-like sources in the image',
    'no_match': 'no rotation of the predicted stars explains the sources in the image',
    'too_few_stars': 'fewer stars were measured well than an image needs',
    'overrun': 'images came faster than they could be measured',
    'internal_error': 'the measurement failed unexpectedly; the log of the node has the cause',
}
"""Why an image can be refused: stable name -> meaning."""

STAR_REFUSALS: Mapping[str, str] = {
    'not_detected': 'bright enough to be seen, but no source stands there',
    'border': 'the core of the star, or its window by moments, leaves the image',
    'blend': 'another catalog star or source is in the measuring window',
    'saturated': 'a pixel of the star is saturated',
    'too_few_pixels': 'too few pixels stand above the noise',
    'elongated': 'not the shape of a star: smear, cosmic ray, hot pixel or galaxy',
    'hot_pixel': 'the light of the star falls on a hot pixel',
    'faint': 'signal-to-noise below the limit',
    'ambiguous': 'off the place or the brightness that the other stars give it',
}
"""Why a single predicted star can be left out: stable name -> meaning."""


@dataclass(frozen=True)
class Image:
    """
    One image as its camera gave it.

    ``time_ns`` is the middle of the exposure; ``pixels`` is (height, width) uint8 or uint16 in
    native byte order.
    """

    time_ns: int
    pixels: NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class AttitudeSample:
    """One star-tracker attitude: takes star-tracker coordinates to ICRF; (4,) xyzw, unit."""

    time_ns: int
    icrf_from_star_tracker_xyzw: Floats


@dataclass(frozen=True)
class CameraGeometry:
    """
    The camera and how it sits on the star tracker: the prior, or a calibration in force.

    ``star_tracker_from_camera_xyzw`` is (4,): the orientation of the camera in the star tracker
    frame, as the wire has it.
    """

    camera: CameraModel
    star_tracker_from_camera_xyzw: Floats


@dataclass(frozen=True)
class StarObservations:
    """
    The stars measured and identified in one image, or why it was refused.

    Attributes
    ----------
    time_ns : int
        Middle of the exposure.
    width, height : int
        Image size, px.
    refusal, detail : str
        Empty, or a name of `IMAGE_REFUSALS` and what was found.
    icrf_from_star_tracker_xyzw : (4,)
        Star tracker attitude at ``time_ns``; identity where there is none.
    attitude_gap_s : float
        Time between the two samples about the image; -1 where there is none.
    catalog_id : (n,) int64
    direction_icrf : (n, 3)
        Apparent unit directions, ICRF axes.
    magnitude : (n,) float32
    measured_px : (n, 2)
        (u, v) of each star.
    covariance_px2 : (n, 3)
        uu, uv, vv of ``measured_px``.
    flux_dn, snr : (n,) float32
    refused_stars : mapping
        Name of `STAR_REFUSALS` -> number of predicted stars left out for it.
    refused_catalog_id : (m,) int64
        Those stars; empty in recordings of before their places were kept.
    refused_px : (m, 2) float32
        (u, v) where each should stand by the match of the others; to be shown, not measured with.
    refused_reason : (m,) uint8
        Which key of ``refused_stars``, counted from 0 in its order.
    background_dn, noise_dn : float
        Median background and 1-sigma noise of one pixel.
    psf_sigma_px : float
        Gaussian width of the stars; 0 where not known.
    catalog_digest : str
        Which catalog the identifiers refer to.
    temperature_degc : float
        Of the camera; NaN where not known.
    """

    time_ns: int
    width: int
    height: int
    refusal: str
    detail: str
    icrf_from_star_tracker_xyzw: Floats
    attitude_gap_s: float
    catalog_id: NDArray[np.int64]
    direction_icrf: Floats
    magnitude: NDArray[np.float32]
    measured_px: Floats
    covariance_px2: Floats
    flux_dn: NDArray[np.float32]
    snr: NDArray[np.float32]
    refused_stars: Mapping[str, int]
    background_dn: float
    noise_dn: float
    psf_sigma_px: float
    catalog_digest: str
    temperature_degc: float = math.nan
    refused_catalog_id: NDArray[np.int64] = dataclasses.field(
        default_factory=lambda: np.empty(0, np.int64)
    )
    refused_px: NDArray[np.float32] = dataclasses.field(
        default_factory=lambda: np.empty((0, 2), np.float32)
    )
    refused_reason: NDArray[np.uint8] = dataclasses.field(
        default_factory=lambda: np.empty(0, np.uint8)
    )

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.catalog_id)

    def refused_places(self) -> dict[str, NDArray[np.float32]]:
        """Places (k, 2) of the refused stars by the name of their reason, px."""
        return {
            name: self.refused_px[self.refused_reason == code]
            for code, name in enumerate(self.refused_stars)
        }

    def select(self, keep: NDArray[np.bool_]) -> StarObservations:
        """Return the same image with only the stars of an (n,) mask."""
        return dataclasses.replace(
            self, **{name: getattr(self, name)[keep] for name in STAR_COLUMNS}
        )


STAR_COLUMNS = (
    'catalog_id',
    'direction_icrf',
    'magnitude',
    'measured_px',
    'covariance_px2',
    'flux_dn',
    'snr',
)
"""The fields of `StarObservations` that hold one row per star."""


def refused_image(
    time_ns: int, width: int, height: int, refusal: str, detail: str, **known: object
) -> StarObservations:
    """Observations without stars: the record of an image that cannot be used."""
    empty = StarObservations(
        time_ns=time_ns,
        width=width,
        height=height,
        refusal=refusal,
        detail=detail,
        icrf_from_star_tracker_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        attitude_gap_s=-1.0,
        catalog_id=np.empty(0, np.int64),
        direction_icrf=np.empty((0, 3)),
        magnitude=np.empty(0, np.float32),
        measured_px=np.empty((0, 2)),
        covariance_px2=np.empty((0, 3)),
        flux_dn=np.empty(0, np.float32),
        snr=np.empty(0, np.float32),
        refused_stars={},
        background_dn=0.0,
        noise_dn=0.0,
        psf_sigma_px=0.0,
        catalog_digest='',
    )
    return dataclasses.replace(empty, **known)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Ensemble:
    """What a calibration is made from: usable images as they came, and counts of the others."""

    images: tuple[StarObservations, ...] = ()
    refused: Mapping[str, int] = dataclasses.field(default_factory=dict)

    @property
    def star_count(self) -> int:
        """Number of star observations."""
        return sum(len(image) for image in self.images)

    def add(self, observations: StarObservations) -> Ensemble:
        """
        Return the ensemble with one more image, kept or counted by its reason.

        One with the stamp of an image held is counted as ``duplicate``, and the first stands,
        whatever the later one holds: a recording played twice does not count twice.
        """
        refusal = observations.refusal
        if not refusal and any(image.time_ns == observations.time_ns for image in self.images):
            refusal = 'duplicate'
        if refusal:
            count = self.refused.get(refusal, 0) + 1
            return Ensemble(self.images, {**self.refused, refusal: count})
        return Ensemble((*self.images, observations), self.refused)


@dataclass(frozen=True)
class EnsembleStatus:
    """
    What has been collected and what a calibration from it would be worth.

    ``coverage`` is (rows, cols) star observations per focal-plane cell;
    ``predicted_sigma`` is 1-sigma per ``parameter_names``, inf where not observable;
    ``images_saved`` of the images are on disk and outlast a crash or a power loss.
    """

    time_ns: int
    images: int
    stars: int
    min_images: int
    min_stars: int
    refused: Mapping[str, int]
    coverage: NDArray[np.int64]
    parameter_names: tuple[str, ...]
    predicted_sigma: Floats
    images_saved: int = 0


@dataclass(frozen=True)
class Thermal:
    """
    How the camera changes with its temperature, as `thermal` states it.

    Attributes
    ----------
    reference_degc : float
        Camera and alignment of the calibration hold at this temperature.
    focal_per_degc, focal_sigma : tuple of 0 to 2 float
        a1 (1/degC) and a2 (1/degC^2), and their 1-sigma.
    alignment_rate_rad_per_degc, alignment_rate_sigma : tuple of 0 or 3 float
        Passive small rotation in the camera frame for each degree, and its 1-sigma.
    note : str
        What was asked for and left out, and why; may be empty.
    """

    reference_degc: float
    focal_per_degc: tuple[float, ...] = ()
    focal_sigma: tuple[float, ...] = ()
    alignment_rate_rad_per_degc: tuple[float, ...] = ()
    alignment_rate_sigma: tuple[float, ...] = ()
    note: str = ''


@dataclass(frozen=True)
class DetectorMaps:
    """
    What a calibration is worth over the detector; the first row is that of the least v.

    Attributes
    ----------
    stars : (rows, cols) int64
        Star observations used, in equal cells that cover the detector.
    line_of_sight_sigma_arcsec : (rows, cols)
        1-sigma of the line of sight of a pixel in the star tracker frame, camera and alignment
        together, at a regular grid of pixels from corner to corner.
    shape_sigma_arcsec : (rows, cols)
        The same of the camera alone, after the turn that is common to all those pixels.
    """

    stars: NDArray[np.int64]
    line_of_sight_sigma_arcsec: Floats
    shape_sigma_arcsec: Floats


@dataclass(frozen=True)
class Correlation:
    """
    Correlations (k, k) of the k named numbers that are not known exactly.

    Camera parameters that were estimated or considered, focal terms, alignment angles and rate.
    """

    names: tuple[str, ...]
    matrix: Floats


@dataclass(frozen=True)
class Removal:
    """
    A calibration after one more term was removed, those before it staying removed.

    Attributes
    ----------
    removed : str
        The term; empty for the calibration with all of them.
    significance : float
        How far the term is from what it is held at without it, in its sigma, with all terms.
    wald : float
        Rise of chi^2 that the covariance before the removal had promised.
    chi2_rise : float
        Against the calibration with all terms, over its stars and with its weights.
    within_chance : bool
        Whether this and all removed before it may be dropped: terms that are none would raise
        chi^2 by as much in more than 1 of 100.
    residual_rms_px : float
        Per axis, over the same stars.
    residual_std_px : (float, float)
        Of u and of v.
    map_change_px : float
        RMS over the detector against the calibration with all terms, the common turn removed.
    """

    removed: str
    significance: float
    wald: float
    chi2_rise: float
    within_chance: bool
    residual_rms_px: float
    residual_std_px: tuple[float, float]
    map_change_px: float


@dataclass(frozen=True)
class Halves:
    """
    How the calibrations of the earlier and the later half of the images differ.

    Attributes
    ----------
    shape_px, shape_chance : float
        Largest movement of a line of sight, common turn removed, px at the focal length; and how
        often chance makes the cameras differ as much.
    turn_arcsec, chance : float
        The common turn; and the same of camera and alignment together.
    """

    shape_px: float
    shape_chance: float
    turn_arcsec: float
    chance: float


@dataclass(frozen=True)
class GateCheck:
    """
    One thing that the gate looks at.

    Attributes
    ----------
    name : str
        What it is, in words.
    option : str
        The parameter that limits it: from below where it begins with ``min_``, else from above.
        Empty for what needs no number: it holds or not.
    found, limit : float
        In ``unit``; ``found`` is NaN where it was not checked, both where there is no number.
    unit : str
        Empty for pure numbers.
    kept : bool or None
        None where it was not checked.
    note : str
        Why it was not checked, or what decided beside the limit; may be empty.
    """

    name: str
    option: str
    found: float
    limit: float
    unit: str
    kept: bool | None
    note: str = ''

    @property
    def is_least(self) -> bool:
        """Whether the limit is the least that is allowed."""
        return self.option.startswith('min_')

    @property
    def found_text(self) -> str:
        """What was found with its unit; empty where there is no number to be found."""
        return self._text(self.found) if self.option and self.kept is not None else ''

    @property
    def limit_text(self) -> str:
        """The limit with its unit; empty where there is none."""
        return self._text(self.limit) if self.option else ''

    def _text(self, value: float) -> str:
        if not math.isfinite(value):
            return 'not a finite number'
        number = f'{value:.4g}' if abs(value) < 1e4 else f'{value:.0f}'
        return f'{number} {self.unit}' if self.unit else number


@dataclass(frozen=True)
class Calibration:
    """
    One calibration with its covariance, statistics and provenance.

    Attributes
    ----------
    time_ns : int
        Stamp of the last image used.
    geometry : CameraGeometry
        The estimated camera and alignment.
    covariance : (13, 13)
        Of `CALIBRATION_PARAMETER_NAMES`; the alignment angles (rad) are passive small rotations
        in the camera frame; zero rows where a parameter was held.
    method : str
    estimated : tuple of str
        Which camera parameters were estimated.
    residual_rms_px : float
        Per axis, over the stars used.
    variance_factor : float
        chi^2 per degree of freedom with the centroid covariances as given.
    images_used, stars_used, stars_rejected : int
    images_refused : mapping
        Reason -> count.
    alignment_scatter_arcsec : float
        RMS per axis of the alignments that the images show, about their mean; 0 for ``single``.
    star_tracker_sigma_arcsec : tuple of 3 float
        About the star tracker's axes, as given or as estimated again.
    centroid_scale, centroid_floor_px : float
        The centroid covariances C were used as ``scale C + floor^2 I``.
    dropped_catalog_ids : tuple of int
        Stars that misfit across images and were left out of all.
    misfit_images_ns : tuple of int
        Stamps of images whose attitude does not fit, or that lost their stars.
    singular_values : tuple of float
        Of the information on what was estimated, scaled to a unit diagonal, largest first.
    weakest_direction : str
        The direction of the smallest, in words.
    zero_skew_cost_px : float
        Worst pixel error of the zero-skew fit that ``camera_info`` carries.
    iterations, termination
        What the solver reported.
    accepted, reasons
        The verdict of the gate.
    provenance : mapping of str to str
    thermal : Thermal or None
        None where no change with temperature was asked for.
    maps : DetectorMaps or None
    correlation : Correlation or None
        None where whoever has made the calibration does not tell.
    removals : tuple of Removal
        First that of no term, then the terms in the order in which they would go; may be empty.
    first_image_ns : int
        Stamp of the first image used.
    number : int
        Counts the calibrations that came into force on one calibrator; 0 for a candidate.
    in_force_since_ns : int
        When it came into force, or came back by a roll-back; 0 for a candidate.
    forced : bool
        It came into force by request, against the gate.
    halves : Halves or None
        None where the halves of the images were not compared.
    gate : tuple of GateCheck
        What the gate has looked at; empty where whoever has made the calibration does not tell.
    """

    time_ns: int
    geometry: CameraGeometry
    covariance: Floats
    method: str
    estimated: tuple[str, ...]
    residual_rms_px: float
    variance_factor: float
    images_used: int
    images_refused: Mapping[str, int]
    stars_used: int
    stars_rejected: int
    alignment_scatter_arcsec: float
    star_tracker_sigma_arcsec: tuple[float, ...]
    centroid_scale: float
    centroid_floor_px: float
    dropped_catalog_ids: tuple[int, ...]
    misfit_images_ns: tuple[int, ...]
    singular_values: tuple[float, ...]
    weakest_direction: str
    zero_skew_cost_px: float
    iterations: int
    termination: str
    accepted: bool
    reasons: tuple[str, ...]
    parent_frame: str
    child_frame: str
    provenance: Mapping[str, str]
    thermal: Thermal | None = None
    maps: DetectorMaps | None = None
    correlation: Correlation | None = None
    removals: tuple[Removal, ...] = ()
    first_image_ns: int = 0
    number: int = 0
    in_force_since_ns: int = 0
    forced: bool = False
    halves: Halves | None = None
    gate: tuple[GateCheck, ...] = ()

    @property
    def sigma(self) -> Floats:
        """1-sigma of `CALIBRATION_PARAMETER_NAMES`, (13,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))
