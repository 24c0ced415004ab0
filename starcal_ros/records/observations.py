# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records of images and of the stars measured in them."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
from enum import IntEnum
import math
from typing import Annotated

import numpy as np

from starcal_ros import record_fields as fields
from starcal_ros.arrays import Codes, Floats, Integers, Mask, Pixels, Singles
from starcal_ros.camera import MAX_SIDE_PX
from starcal_ros.constants import MAX_STAMP_NS, NANOSECONDS_PER_SECOND

IMAGE_REFUSALS: Mapping[str, str] = {
    'bad_encoding': 'the pixel encoding is not one of mono8, mono16, 8UC1, 16UC1',
    'bad_layout': (
        'size, row step and data length of the image message are inconsistent, or the message is'
        ' truncated'
    ),
    'wrong_size': 'the image is not of the size of the prior camera',
    'bad_attitude': 'the attitude near the image is not finite or not of unit length',
    'frozen_attitude': 'the star tracker repeats an earlier attitude, but the stars have moved',
    'no_attitude': 'no attitude sample on both sides of the image',
    'attitude_gap': 'the attitude samples before and after the image are too far apart',
    'out_of_order': 'the stamp is not later than the stamp of the last image',
    'duplicate': 'the ensemble has an image with the same stamp or of the same exposure',
    'overexposed': 'too large a fraction of the image is saturated',
    'blank': 'every pixel has the same value',
    'frozen': 'the pixels are identical to the image before, which has another stamp',
    'incomplete': ('part of the image is constant, repeated, shifted or from an earlier image'),
    'glare': 'the background varies too strongly over most of the image to be subtracted',
    'no_stars': 'too few star-like sources in the image',
    'smeared': 'the camera turned too far during the exposure: streaks of over 10 px',
    'no_match': 'no rotation of the predicted stars explains the sources in the image',
    'not_in_catalog': 'the catalog has too few stars where the image points',
    'too_few_stars': 'too few stars were measured well',
    'bad_stamp': 'the stamp, with stamp_offset_s, is negative or beyond the range of ROS stamps',
    'bad_observations': (
        'the observations cannot be decoded, contain impossible values, or are of another'
        ' camera_frame (reported by the calibrator)'
    ),
    'overrun': 'images came faster than they could be measured',
    'internal_error': 'the measurement failed unexpectedly; the log of the node has the cause',
    'other': 'the sender gave a reason that this version does not have',
}
"""Reasons to refuse an image: stable name -> meaning."""
_REFUSAL = fields.OneOf(('', *IMAGE_REFUSALS))  # Sphinx cannot show a star within an annotation


def counted_refusal(refusal: str) -> str:
    """
    Name under which a refused image is counted.

    All unknown reasons share one name.  The counts are in every status and in a file, and must
    not grow with texts that a sender invents.
    """
    return refusal if refusal in IMAGE_REFUSALS else 'other'


class StarRefusal(IntEnum):
    """
    Reasons to leave out a single predicted star, as codes of ``uint8`` arrays.

    Messages and files hold the `label`, because codes of another version may differ.
    """

    meaning: str

    def __new__(cls, code: int, meaning: str = '') -> StarRefusal:
        """Return a member with its meaning."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.meaning = meaning
        return member

    NONE = 0, 'the star is used'
    AMBIGUOUS = 1, 'position or brightness contradicts the other stars'
    BLEND = 2, 'another catalog star or source is in the measuring window'
    BORDER = 3, 'the core of the star, or its window for moments, extends beyond the image'
    ELONGATED = 4, 'not the shape of the other stars: cosmic ray, hot pixel or galaxy'
    FAINT = 5, 'signal-to-noise below the limit'
    HOT_PIXEL = 6, 'the light of the star falls on a hot pixel'
    NOT_DETECTED = 7, 'bright enough to be detected, but there is no source'
    SATURATED = 8, 'a pixel of the star is saturated'
    TOO_FEW_PIXELS = 9, 'too few pixels are above the noise'

    @property
    def label(self) -> str:
        """Name in messages and files."""
        return self.name.lower()


STAR_REFUSALS: Mapping[str, str] = {
    refusal.label: refusal.meaning for refusal in StarRefusal if refusal is not StarRefusal.NONE
}
"""Reasons to leave out a single predicted star: stable name -> meaning."""


@dataclasses.dataclass(frozen=True)
class Image:
    """
    One image as its camera gave it.

    ``time_ns`` is the middle of the exposure; ``pixels`` is (height, width) uint8 or uint16 in
    native byte order.
    """

    time_ns: int
    pixels: Pixels


@dataclasses.dataclass(frozen=True)
class AttitudeSample:
    """One star-tracker attitude: takes star-tracker coordinates to ICRF; (4,) xyzw, unit."""

    time_ns: int
    icrf_from_star_tracker_xyzw: Floats


LEAST_DEGC, MOST_DEGC = -273.15, 1000.0
"""Lowest and highest temperature of a camera."""
_Name = Annotated[str, fields.Most(most_characters=100)]
_Side = Annotated[int, fields.Within(0, MAX_SIDE_PX)]
# Rounding to single precision is smaller.
_Attitude = Annotated[fields.Quaternion, fields.Unit(1e-3)]
_FiniteOrNaN = Annotated[float, fields.Within()]
_FloatsOrNaN = Annotated[Singles, fields.Within(), fields.Shape(('n',))]
_Vector = Annotated[Floats, fields.Shape((3,))]
_UNKNOWN, _IDENTITY = np.full(3, math.nan), np.array([0.0, 0.0, 0.0, 1.0])


def _no_rows() -> Singles:
    """A column that is not known, in the record of no star."""
    return np.empty(0, np.float32)


@dataclasses.dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StarObservations(fields.Record):
    """
    The stars measured and identified in one image, or the reason of its refusal.

    A message needs the fields without a default; the default of another one means not known.

    Attributes
    ----------
    time_ns : int
        Middle of the exposure.
    width, height : int
        Image size, px.
    refusal, detail : str
        Empty, or a name of `IMAGE_REFUSALS` and the finding in words.
    icrf_from_star_tracker_xyzw : (4,)
        Star tracker attitude at ``time_ns``; identity if there is none.
    star_tracker : str
        Frame of the star tracker that gave the attitude; empty: the first, or the only one, or in
        memory none.
    first_from_star_tracker_xyzw : (4,)
        Orientation of that star tracker in the frame of the first, as assumed; the identity for
        the first.  ``icrf_from_star_tracker`` times it is the attitude as received.
    attitude_gap_s : float
        Time between the two samples around the image; NaN without a sample on both sides.
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
        Name of `STAR_REFUSALS` -> number of predicted stars refused for this reason.
    refused_catalog_id : (m,) int64
        The refused stars.
    refused_px : (m, 2) float32
        Predicted (u, v) of each refused star; for display only.
    refused_reason : (m,) uint8
        Index of the reason among the keys of ``refused_stars``.
    background_dn, noise_dn : float
        Median background and 1-sigma noise of one pixel.
    psf_sigma_px : float
        Gaussian width of the stars; 0 if unknown.
    catalog_digest : str
        Digest of the catalog of the identifiers.
    temperature_degc : float
        Temperature of the camera; NaN if unknown.
    star_tracker_rate_rad_s : (3,)
        Angular rate at ``time_ns`` by the attitude samples, in the frame of the first star
        tracker; NaN if unknown.
    star_tracker_rate_sigma_rad_s : (3,)
        1-sigma of that about the axes of that frame; NaN if unknown.
    velocity_sigma_m_s : float
        1-sigma of each component of the observer's velocity in ``direction_icrf``; 0 for a site on
        the ground, NaN if not known: none was given and that of the Earth was used, or one that
        may be about the Earth.
    zenith_icrf : (3,)
        Zenith of the refraction in ``direction_icrf``, by the site and the stamp or found from the
        stars; NaN in space.
    refraction_arcsec : (2,)
        Refraction at a zenith distance of 45 degrees for that zenith, and its 1-sigma; else zeros.
    pixel_digest : str
        Digest of the pixels, by which an image is recognised that comes again with another stamp;
        empty if unknown.

    Examples
    --------
    >>> image = StarObservations.of_image(1_700_000_000_000_000_000, (1024, 768))
    >>> len(image), image.measured_px.shape, image.temperature_degc
    (0, (0, 2), nan)
    """

    time_ns: fields.Stamp
    width: _Side
    height: _Side
    refusal: Annotated[str, _REFUSAL] = ''
    detail: str = ''
    icrf_from_star_tracker_xyzw: Annotated[_Attitude, fields.Named('attitude')]
    attitude_gap_s: Annotated[float, fields.Within(0)] = math.nan
    catalog_id: Annotated[Integers, fields.Shape(('n',))]
    direction_icrf: Annotated[Floats, fields.Finite(), fields.Shape(('n', 3)), fields.Unit(1e-6)]
    magnitude: _FloatsOrNaN = dataclasses.field(default_factory=_no_rows)
    measured_px: Annotated[Floats, fields.Finite(), fields.Shape(('n', 2))]
    covariance_px2: Annotated[Floats, fields.Finite(), fields.Shape(('n', 3))]
    flux_dn: _FloatsOrNaN = dataclasses.field(default_factory=_no_rows)
    snr: _FloatsOrNaN = dataclasses.field(default_factory=_no_rows)
    refused_stars: Annotated[Mapping[str, fields.Count], fields.Most(100, most_items=50)] = (
        dataclasses.field(default_factory=dict)
    )
    background_dn: _FiniteOrNaN = 0.0
    noise_dn: _FiniteOrNaN = 0.0
    psf_sigma_px: _FiniteOrNaN = 0.0
    catalog_digest: _Name = ''
    temperature_degc: Annotated[float, fields.Within(LEAST_DEGC, MOST_DEGC)] = math.nan
    star_tracker: _Name = ''
    first_from_star_tracker_xyzw: Annotated[_Attitude, fields.Named('first_from_star_tracker')] = (
        dataclasses.field(default_factory=_IDENTITY.copy)
    )
    refused_catalog_id: Annotated[
        Integers, fields.Shape(('m',)), fields.Named('refused_star_id')
    ] = dataclasses.field(default_factory=lambda: np.empty(0, np.int64))
    refused_px: Annotated[
        Singles, fields.Finite(), fields.Shape(('m', 2)), fields.Named('refused_star_px')
    ] = dataclasses.field(default_factory=lambda: np.empty((0, 2), np.float32))
    refused_reason: Annotated[Codes, fields.Shape(('m',)), fields.Named('refused_star_reason')] = (
        dataclasses.field(default_factory=lambda: np.empty(0, np.uint8))
    )
    star_tracker_rate_rad_s: Annotated[_Vector, fields.Within()] = dataclasses.field(
        default_factory=_UNKNOWN.copy
    )
    star_tracker_rate_sigma_rad_s: Annotated[_Vector, fields.Within(0)] = dataclasses.field(
        default_factory=_UNKNOWN.copy
    )
    velocity_sigma_m_s: Annotated[float, fields.Within(0)] = math.nan
    zenith_icrf: Annotated[_Vector, fields.Within(), fields.Unit(1e-6)] = dataclasses.field(
        default_factory=_UNKNOWN.copy
    )
    refraction_arcsec: Annotated[Floats, fields.Finite(), fields.Shape((2,))] = dataclasses.field(
        default_factory=lambda: np.zeros(2)
    )
    pixel_digest: _Name = ''

    @classmethod
    def of_image(cls, time_ns: int, size: tuple[int, int], **known: object) -> StarObservations:
        """Return observations of an image of (width, height) px; unstated fields are unknown."""
        empty = cls(
            time_ns=time_ns,
            width=size[0],
            height=size[1],
            icrf_from_star_tracker_xyzw=_IDENTITY.copy(),
            catalog_id=np.empty(0, np.int64),
            direction_icrf=np.empty((0, 3)),
            measured_px=np.empty((0, 2)),
            covariance_px2=np.empty((0, 3)),
        )
        return dataclasses.replace(empty, **known)  # type: ignore[arg-type]

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.catalog_id)

    def refused_places(self) -> dict[str, Singles]:
        """Positions (k, 2) of the refused stars by the name of the reason, px."""
        return {
            name: self.refused_px[self.refused_reason == code]
            for code, name in enumerate(self.refused_stars)
        }

    def select(self, keep: Mask) -> StarObservations:
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
    """
    Observations without stars: the record of an image that cannot be used, and why.

    The nearest that a message can hold replaces a stamp or side that none can hold.
    """
    time_ns = min(max(time_ns, 0), MAX_STAMP_NS)
    size = min(width, MAX_SIDE_PX), min(height, MAX_SIDE_PX)
    return StarObservations.of_image(time_ns, size, refusal=refusal, detail=detail, **known)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Ensemble(fields.Record):
    """
    The input of a calibration: usable images in order of arrival, and counts of the others.

    >>> image = StarObservations.of_image(1_700_000_000_000_000_000, (1024, 768))
    >>> ensemble = Ensemble().add(image).add(image)  # the same stamp
    >>> len(ensemble.images), ensemble.refused
    (1, {'duplicate': 1})
    """

    images: tuple[StarObservations, ...] = ()
    refused: Mapping[str, int] = dataclasses.field(default_factory=dict)

    @property
    def star_count(self) -> int:
        """Number of star observations."""
        return sum(len(image) for image in self.images)

    def add(self, observations: StarObservations) -> Ensemble:
        """
        Return the ensemble with one more image, kept or counted by its reason.

        An image that `repeats` one of the ensemble is counted as ``duplicate`` and the first one
        stays, so that a recording played twice does not count twice.
        """
        refusal = observations.refusal
        if not refusal and self.repeats(observations):
            refusal = 'duplicate'
        if refusal:
            refusal = counted_refusal(refusal)
            count = self.refused.get(refusal, 0) + 1
            return Ensemble(self.images, {**self.refused, refusal: count})
        return Ensemble((*self.images, observations), self.refused)

    def repeats(self, observations: StarObservations) -> str:
        """
        Words on the image of the ensemble that observations repeat, empty for a new image.

        It has the stamp or the pixels of theirs.  Noise makes any two exposures differ.
        """
        for image in self.images:
            if image.time_ns == observations.time_ns:
                return 'the stamp of another image'
            if image.pixel_digest and image.pixel_digest == observations.pixel_digest:
                since_s = (observations.time_ns - image.time_ns) / NANOSECONDS_PER_SECOND
                return f'the pixels of the image {since_s:.3f} s before'
        return ''


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class EnsembleStatus(fields.Record):
    """
    Images and stars collected so far, and the precision of a calibration made from them.

    ``coverage`` is (rows, cols) star observations per focal-plane cell;
    ``predicted_sigma`` is 1-sigma per ``parameter_names``, inf where not observable;
    ``images_saved`` counts the images on disk, which survive a crash or a power loss.
    """

    time_ns: fields.Stamp
    images: fields.Count
    stars: fields.Count
    min_images: fields.Count
    min_stars: fields.Count
    refused: Mapping[str, fields.Count]
    coverage: Annotated[Integers, fields.Shape(('coverage_rows', 'coverage_cols'))]
    parameter_names: Annotated[tuple[str, ...], fields.Shape(('k',))]
    predicted_sigma: Annotated[Floats, fields.Shape(('k',))]
    images_saved: fields.Count = 0
