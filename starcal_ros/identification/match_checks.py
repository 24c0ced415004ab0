# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Checks of a match by what its search did not use: jumps of the residuals, and brightness.

A line lost in transmission shifts all rows below it by whole pixels.  The stars below still lie in
their windows, but their residuals jump against those above, whereas errors of camera and attitude
vary smoothly over the image.

In a crowded field, or where part of a field resembles another one, positions can match by chance.
Brightnesses do not match then.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Mask
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.acquisition import best_share, missed_parts, part_of, PARTS
from starcal_ros.identification.prediction import polynomial_terms
from starcal_ros.records import StarRefusal
from starcal_ros.robust_statistics import MAD_TO_SIGMA, median, RAYLEIGH_TO_SIGMA
from starcal_ros.stars.centroiding import Centroids
from starcal_ros.stars.image_model import ImageModel
from starcal_ros.stars.pixel_noise import expected_snr

_STARS_OF_DEGREE = {5: 60, 3: 20}  # polynomial degree: fewest stars
_EACH_SIDE = 8  # fewest stars on each side of a jump
_MOST_STARS = 150  # stars used; more take longer and add little
_CUTS = 48  # rows tested; one or two stars on the wrong side do not hide a jump
_AGREE = 0.7  # share of the stars of a side that must follow the jump
_LEAST_PX = 0.5  # whole rows or columns are lost
# Rise of chi^2 without the jump.  290 intact frames stayed below 10 after outliers had lost their
# weight; normal noise reaches 40 at one of the cuts once in 10^7.
_LEAST_RISE = 40.0
_FLOOR_PX = 0.05  # systematic error of star positions, per axis


def find_line_loss(
    predicted_px: Floats, measured_px: Floats, sigma_px: Floats, shape: tuple[int, ...]
) -> tuple[int, Floats] | None:
    """
    First row after lost lines, about, and the offset (2,) of those below, px; None without a jump.

    ``predicted_px``, ``measured_px`` (n, 2) of the good stars, ``sigma_px`` (n,) noise per axis.
    For each tested row, a robust fit of the residuals with a polynomial in u and v and a step.  A
    smooth error of the prior, even a large one, is not a jump.
    """
    # The smooth part can take up half of a jump.
    away_px = np.hypot(*(measured_px - predicted_px).T) - 2.0 * sigma_px
    if np.count_nonzero(away_px > 0.5 * _LEAST_PX) < _EACH_SIDE // 2:
        return None
    if len(predicted_px) > _MOST_STARS:
        best = np.argpartition(sigma_px, _MOST_STARS)[:_MOST_STARS]
        predicted_px, measured_px, sigma_px = predicted_px[best], measured_px[best], sigma_px[best]
    n = len(predicted_px)
    degree = next((power for power, least in _STARS_OF_DEGREE.items() if n >= least), None)
    if degree is None:
        return None
    height, width = shape
    rows = np.linspace(0.0, height, _CUTS + 2)[1:-1]
    below = predicted_px[:, 1, None] > rows
    count = below.sum(axis=0)
    usable = (count >= _EACH_SIDE) & (count <= n - _EACH_SIDE)
    if not usable.any():
        return None
    rows, steps = rows[usable], below[:, usable].astype(np.float64)
    middle_px = np.array([width, height]) / 2.0
    smooth = polynomial_terms((predicted_px - middle_px) / middle_px.max(), degree)
    root = 1.0 / np.hypot(sigma_px, _FLOOR_PX)
    weight = root
    for power in (0.5, 1.0, 1.0, 1.0):
        Q, _ = np.linalg.qr(smooth * weight[:, None])
        left = (measured_px - predicted_px) * weight[:, None]
        left = left - Q @ (Q.T @ left)
        jump = steps * weight[:, None]
        jump = jump - Q @ (Q.T @ jump)
        size2 = (jump**2).sum(axis=0)
        off_px = (jump.T @ left) / np.maximum(size2, 1e-9)[:, None]
        rise = size2 * (off_px**2).sum(axis=1)
        k = int(rise.argmax())
        if rise[k] < _LEAST_RISE:
            return None
        off_sigma = np.hypot(*(left - jump[:, [k]] * off_px[k]).T) * root / weight
        scatter = max(1.0, median(off_sigma) * RAYLEIGH_TO_SIGMA)
        weight = root / scatter / (1.0 + (off_sigma / (3.0 * scatter)) ** 2) ** power
    agree = off_sigma < 4.0 * scatter
    side = steps[:, k] == (2.0 * steps[:, k].mean() < 1.0)  # the side with fewer stars
    if np.hypot(*off_px[k]) < _LEAST_PX or agree[side].mean() < _AGREE:
        return None
    return round(float(rows[k])), off_px[k]


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
    blurred_px, noise_dn = model.blurred_px, model.background.noise_dn
    zero_point = magnitude[good] + 2.5 * np.log10(centroids.flux_dn[good])
    # Peaks of noise lie near faint catalog stars by chance. The zero point of the brightest stars
    # shows which stars are too faint to be detected: their measurements are noise.
    brightest = np.argsort(magnitude[good], kind='stable')[:_BRIGHTEST]
    highest = median(zero_point[brightest])
    most_dn = 10.0 ** (0.4 * (highest - magnitude[good].astype(np.float64)))
    unseen = expected_snr(most_dn, blurred_px, noise_dn, model.pixel_noise) < min_snr
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
    seen = expected_snr(least_dn, blurred_px, noise_dn, model.pixel_noise) > min_snr
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
    part = part_of(predicted_px, shape)
    found = np.bincount(part[seen & kept], minlength=PARTS)
    shown = found + np.bincount(part[gone], minlength=PARTS)
    if not missed_parts(shown, found).any():
        return np.zeros_like(kept)
    # Accept only parts with at least half the share of the best one.
    accepted = (shown > 0) & (found >= 0.5 * best_share(shown, found) * shown)
    return np.asarray(kept & ~accepted[part])
