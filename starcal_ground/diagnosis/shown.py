# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Camera, rotations and shapes of stars that identified images show, beside the set-up stated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import functools
import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.blind.common_camera import CommonCamera
from starcal_ground.blind.images import Solved
from starcal_ground.diagnosis.attitude_readings import Case, prior_alignment, Reading
from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel
from starcal_ros.pipeline.setup import Setup
from starcal_ros.robust_statistics import MAD_TO_SIGMA

SIGMAS = 3.0  # significance with which the stars show the principal point elsewhere
_FAINTER = 0.8  # share of the brightest peak up to which a star is surely not saturated
_FEW_IN_AN_IMAGE = 5  # stars whose brightnesses are compared with each other
_FEW_SHAPES = 5  # stars whose median extent one blend does not move
_ALONG = 0.5  # least length of the mean axis of stars that are elongated one way
_CHANCE = 500.0  # stars of axes in all directions exceed a longer mean once in so many cases
_FAR_DEX = 0.2  # least difference of two stars: half a magnitude, twice their usual scatter


class StarShape(NamedTuple):
    """
    Medians of the 1-sigma extents of identified stars, px, along and across.

    ``along_deg`` is their direction from +u towards +v, NaN where they have no common one.
    """

    stars: int
    long_px: float
    wide_px: float
    along_deg: float


@dataclass(frozen=True)
class Shown:
    """
    Camera and rotations that identified images show, and the set-up to hold against them.

    ``tried`` is the number of images looked at.  ``bins`` are the pixels of the prior camera along
    one of the images, 0 for another focal length; ``stated`` is the prior camera in the pixels of
    the images, as far as it states them.  ``free`` is the camera of all images, ``held`` the same
    with the principal point stated.  ``refused`` is the most frequent reason for which a
    measurement with the set-up refuses images; empty: none.
    """

    solved: Sequence[Solved]
    tried: int
    case: Case
    setup: Setup
    bins: int
    stated: CameraModel
    free: CommonCamera
    held: CommonCamera
    shift_s: float
    refused: str

    @functools.cached_property
    def reading(self) -> Reading | None:
        """The reading of the attitudes, its alignment that of the principal point stated."""
        reading = self.case.best_reading() if self.has_attitudes else None
        if reading is None or self.centre_is_free:
            return reading
        return reading.with_camera(self._free_from_held)

    @property
    def read(self) -> Reading:
        """The reading, where there is one."""
        assert self.reading is not None
        return self.reading

    @functools.cached_property
    def _free_from_held(self) -> Rotation:
        # A shift of the principal point is a rotation of all cameras alike.
        return (self.free.camera_from_icrf * self.held.camera_from_icrf.inv()).mean()

    def _for_free(self, reading: Reading) -> Reading:
        return reading.with_camera(self._free_from_held.inv())

    @property
    def has_attitudes(self) -> bool:
        """True if there are attitudes of a star tracker, which somebody has given."""
        return self.setup.has_tracker and len(self.case.attitudes.time_ns) > 1

    @property
    def states_camera(self) -> bool:
        """True if the prior camera is not the one that the stars have given."""
        return self.setup.has_tracker or bool(self.setup.frames.camera_info_url)

    @property
    def is_mirrored(self) -> bool:
        """True if the images are mirror images."""
        return self.solved[0].sky.mirrored

    @property
    def is_of_another_size(self) -> bool:
        """True if the images are not of the size of the prior camera."""
        camera, prior = self.free.camera, self.setup.prior.camera
        return (camera.width, camera.height) != (prior.width, prior.height)

    @property
    def centre_is_free(self) -> bool:
        """True if the principal point is not stated: that of a region of the detector."""
        return self.is_of_another_size and self.bins <= 1

    @property
    def focal_px(self) -> float:
        """Focal length of the images."""
        return float(self.free.camera.parameters[0])

    @functools.cached_property
    def centre_off_px(self) -> Floats:
        """Principal point (2,) of the images less the one stated."""
        return np.asarray(self.free.camera.parameters[3:5] - self.stated.parameters[3:5])

    @functools.cached_property
    def centre_is_off(self) -> bool:
        """
        True if the stars show a principal point that explains why no image matches.

        It has to explain it alone, or to be off by three times the 1-sigma that a calibration
        assumes, which can take up less.
        """
        if self.centre_is_free or self.solved[0].quarter_turned:
            return False
        camera = self.free.camera
        off_px, longer = np.abs(self.centre_off_px), max(camera.width, camera.height)
        is_shown = bool((off_px > SIGMAS * np.array(self.free.centre_sigma_px)).any())
        sigmas = float(np.hypot(*off_px)) / longer / self.setup.calibration.principal_point_prior
        if not is_shown or sigmas < 1.0:
            return False
        prior, reading = prior_alignment(self.setup), self.reading
        if reading is None or prior is None:
            return self.refused == 'no_match' and sigmas > SIGMAS
        if self.refused != 'no_match' and not reading.is_off(prior, self.setup):
            return False
        return sigmas > SIGMAS or not self._for_free(reading).is_off(prior, self.setup)

    @functools.cached_property
    def alignment(self) -> Reading | None:
        """The reading with the alignment that goes with the principal point to use."""
        if not (self.reading and self.centre_is_off):
            return self.reading
        return self._for_free(self.reading)

    @functools.cached_property
    def star_shape(self) -> StarShape | None:
        """Shape of the stars that are not saturated; None for fewer than five."""
        return shape_of(self.solved)

    def brightness_slope(self) -> tuple[float, float] | None:
        """Power of the catalog's light that stars follow, and its sigma; None: unknown."""
        images = []
        for image, rows, stars in _unsaturated(self.solved):
            if len(rows) >= _FEW_IN_AN_IMAGE:
                magnitude = self.setup.catalog.magnitude[stars]
                images.append((-0.4 * magnitude, np.log10(image.sources.flux_dn[rows])))
        # Theil and Sen: outliers are variables, doubles and saturated stars.
        slopes = []
        for catalog, measured in images:
            i, j = np.triu_indices(len(catalog), 1)
            far = np.abs(catalog[i] - catalog[j]) > _FAR_DEX
            slopes.append((measured[i] - measured[j])[far] / (catalog[i] - catalog[j])[far])
        if not slopes or not len(np.concatenate(slopes)):
            return None
        slope = float(np.median(np.concatenate(slopes)))
        off = [measured - slope * catalog for catalog, measured in images]
        scatter = MAD_TO_SIGMA * np.median(np.abs(np.concatenate([o - np.median(o) for o in off])))
        spread = sum(float(((catalog - catalog.mean()) ** 2).sum()) for catalog, _ in images)
        return slope, float(scatter) / math.sqrt(spread)


def _unsaturated(solved: Sequence[Solved]) -> Iterator[tuple[Solved, Indices, Indices]]:
    """Identified images, rows (n,) of their sources that are stars, and of the catalog."""
    for image in solved:
        place = {tuple(xy): k for k, xy in enumerate(image.sources.xy_px.tolist())}
        rows = np.array([place.get(tuple(xy), -1) for xy in image.sky.xy_px.tolist()], np.int64)
        peak_dn = image.sources.peak_dn
        good = (rows >= 0) & (peak_dn[rows] < _FAINTER * peak_dn.max(initial=0.0))
        yield image, rows[good], image.sky.catalog_index[good]


def shape_of(solved: Sequence[Solved], bins: int = 1) -> StarShape | None:
    """Shape of the stars of images with so many pixels to a bin; None for fewer than five."""
    parts = [
        np.stack([source.long_px, source.wide_px, source.along_rad])[:, rows]
        for image, rows, _ in _unsaturated(solved)
        for source in [image.sources]
    ]
    long_px, wide_px, along_rad = np.concatenate(parts, axis=1)
    if len(long_px) < _FEW_SHAPES:
        return None
    double = np.exp(2j * along_rad).mean()  # an axis has two directions
    # Rayleigh's test of directions that are uniform.
    least = max(_ALONG, math.sqrt(math.log(_CHANCE) / len(along_rad)))
    is_common = abs(double) > least
    along_deg = math.degrees(0.5 * float(np.angle(double))) if is_common else math.nan
    middle_px = bins * np.median([long_px, wide_px], axis=1)
    return StarShape(len(long_px), float(middle_px[0]), float(middle_px[1]), along_deg)
