# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Comparison of measured brightnesses with catalog magnitudes.

In a crowded field, or where part of a field resembles another one, positions can match by chance.
Brightnesses do not match then; they are independent of the search by position.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Mask
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.acquisition import best_share, missed_parts, part_of, PARTS
from starcal_ros.records import StarRefusal
from starcal_ros.robust_statistics import MAD_TO_SIGMA, median
from starcal_ros.stars.centroiding import Centroids
from starcal_ros.stars.image_model import ImageModel
from starcal_ros.stars.pixel_noise import expected_snr

_FEWEST = 4  # stars: fewer give no meaningful scatter or share
# A camera's band is not V: stars of a real sky scatter by 0.15 to 0.3 mag, none of 2000 was off
# by 1.5; a lens may dim its corners by 1.  Stars met by chance scatter by 1.0 to 1.7 mag.
_BRIGHTEST = 20  # good stars, brightest in the catalog, that give a first zero point
_MOST_OFF = 2.0  # largest deviation of a star, in units of the largest scatter


def refuse_by_brightness(
    magnitude: NDArray[np.floating],
    predicted_px: Floats,
    centroids: Centroids,
    model: ImageModel,
    min_snr: float,
    max_scatter_mag: float,
) -> NDArray[np.uint8]:
    """
    Refusal reasons (n,) after a comparison of measured brightness with catalog magnitude.

    A measured star with an outlying brightness becomes ``ambiguous``; a ``faint`` star that should
    be bright enough becomes ``not_detected``.  If one part of the image lacks almost all expected
    stars while another part has them, the few stars found in such parts become ``ambiguous`` too.

    ``magnitude`` (n,) and ``predicted_px`` (n, 2) are from the catalog.  Stars below ``min_snr``
    are faint; ``max_scatter_mag`` is the largest scatter of a true match.

    Raises ImageRefused ``no_match`` if the brightnesses of most stars contradict the match.
    """
    refusal = centroids.refusal.copy()
    good = np.flatnonzero(refusal == StarRefusal.NONE)
    if len(good) < _FEWEST:
        return refusal
    psf_sigma_px, noise_dn = model.psf_sigma_px or 1.0, model.background.noise_dn
    zero_point = magnitude[good] + 2.5 * np.log10(centroids.flux_dn[good])
    # Peaks of noise lie near faint catalog stars by chance. The zero point of the brightest stars
    # shows which stars are too faint to be detected: their measurements are noise.
    brightest = np.argsort(magnitude[good], kind='stable')[:_BRIGHTEST]
    highest = median(zero_point[brightest])
    most_dn = 10.0 ** (0.4 * (highest - magnitude[good].astype(np.float64)))
    unseen = expected_snr(most_dn, psf_sigma_px, noise_dn, model.pixel_noise) < min_snr
    refusal[good[unseen]] = StarRefusal.FAINT
    good, zero_point = good[~unseen], zero_point[~unseen]
    if len(good) < _FEWEST:
        return refusal
    off_mag = np.abs(zero_point - median(zero_point))
    scatter_mag = MAD_TO_SIGMA * median(off_mag)
    if scatter_mag > max_scatter_mag:
        raise ImageRefused(
            'no_match',
            f'{len(good)} stars match catalog positions,'
            f' but their brightnesses scatter by {scatter_mag:.1f} mag',
        )
    most_mag = max(_MOST_OFF * max_scatter_mag, 5.0 * scatter_mag)
    refusal[good[off_mag > most_mag]] = StarRefusal.AMBIGUOUS
    # Stars bright enough to be detected even if they are fainter by the largest deviation.
    faintest = median(zero_point) - most_mag
    least_dn = 10.0 ** (0.4 * (faintest - magnitude.astype(np.float64)))
    seen = expected_snr(least_dn, psf_sigma_px, noise_dn, model.pixel_noise) > min_snr
    refusal[seen & (refusal == StarRefusal.FAINT)] = StarRefusal.NOT_DETECTED
    alone = _alone_in_part(refusal, seen, predicted_px, model.background.shape)
    refusal[alone] = StarRefusal.AMBIGUOUS
    return refusal


def _alone_in_part(
    refusal: NDArray[np.uint8], seen: Mask, predicted_px: Floats, shape: tuple[int, ...]
) -> Mask:
    """Mask (n,) of the good stars in parts of the image that lack most of the ``seen`` stars."""
    kept = refusal == StarRefusal.NONE
    gone = seen & ((refusal == StarRefusal.NOT_DETECTED) | (refusal == StarRefusal.AMBIGUOUS))
    if np.count_nonzero(gone) < _FEWEST - 1:
        return np.zeros_like(kept)
    height, width = shape
    part = part_of(predicted_px, width, height)
    found = np.bincount(part[seen & kept], minlength=PARTS)
    shown = found + np.bincount(part[gone], minlength=PARTS)
    if not missed_parts(shown, found).any():
        return np.zeros_like(kept)
    # Accept only parts with at least half the share of the best one.
    accepted = (shown > 0) & (found >= 0.5 * best_share(shown, found) * shown)
    return np.asarray(kept & ~accepted[part])
