# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Sections of the report: main results and parameters as rows; images, pictures, refusals."""

from __future__ import annotations

import base64
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import astuple
import math

from markupsafe import Markup
import numpy as np

from starcal_ground.report.thumbnails import star_of, Thumbnail
from starcal_ground.report.verdict import Row
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.constants import ARCSECOND_RAD, utc_text
from starcal_ros.pipeline.annotation import LETTERS, STAR_MARKS
from starcal_ros.records import Calibration, IMAGE_REFUSALS, STAR_REFUSALS, StarObservations, TOTAL
from starcal_ros.text import significant


def typeset(rows: Sequence[Row]) -> list[Row]:
    """Rows with minus signs in place of hyphens."""
    return [Row(*(text.replace('-', '\N{MINUS SIGN}') for text in astuple(row))) for row in rows]


def _none(count: int) -> str:
    return f'{count:,}' if count else 'none'


def tiles(calibration: Calibration) -> list[tuple[str, str, str]]:
    """(name, number, note) of the main results."""
    rms_px = calibration.residual_rms_px
    pixel_arcsec = 1.0 / calibration.geometry.camera.parameters[0] / ARCSECOND_RAD
    in_arcsec = f'{rms_px * pixel_arcsec:.2f}″ at {pixel_arcsec:.1f}″ per pixel'
    refused = _none(sum(calibration.images_refused.values()))
    misfits = _none(len(calibration.misfit_images_ns))
    outliers = _none(calibration.stars_rejected)
    results = [
        ('Residual', f'{rms_px:.3f} px', f'rms per axis; {in_arcsec}'),
        (
            'Images',
            f'{calibration.images_used:,}',
            f'used; {refused} refused; attitude misfits among those used: {misfits}',
        ),
        ('Stars', f'{calibration.stars_used:,}', f'used; outliers left out: {outliers}'),
    ]
    maps = calibration.maps
    if maps is not None:
        total = next((part for part in calibration.sigma_budget if part.cause == TOTAL), None)
        scopes = (
            ('Line of sight', maps.line_of_sight_sigma_arcsec,
             total.pointing_arcsec if total else None, 'in the star tracker frame'),
            ('Camera alone', maps.shape_sigma_arcsec, total.map_arcsec if total else None,
             'common rotation removed'),
        )  # fmt: skip
        for name, sigma, rms, text in scopes if calibration.has_alignment else scopes[1:]:
            worst = f'at most {significant(sigma.max(), 3)}″'
            if rms is None:
                results.append((name, worst, f'1-sigma, {text}'))
            else:
                note = f'1-sigma, rms over the detector, {text}; {worst}'
                results.append((name, f'{significant(rms, 2)}″', note))
    return results


_SLIDER_IMAGES, _SLIDER_STARS = 40, 12000  # in the page; a star takes 25 bytes
_LISTED_REFUSED = 200


def slider(calibration: Calibration, residuals: Residuals | None) -> Mapping[str, object] | None:
    """Data of the single-image view: positions in px, residuals in 0.001 px."""
    if residuals is None or len(residuals.image_time_ns) == 0:
        return None
    camera, typical_px = calibration.geometry.camera, max(calibration.residual_rms_px, 1e-6)
    count = len(residuals.image_time_ns)
    mean_stars = max(1.0, len(residuals.image) / count)
    most = max(1, min(_SLIDER_IMAGES, int(_SLIDER_STARS / mean_stars)))
    chosen = np.rint(np.linspace(0, count - 1, min(count, most))).astype(int).tolist()
    rms = residuals.image_rms_px()
    images = []
    for k in chosen:
        here = residuals.image == k
        place = np.rint(residuals.measured_px[here]).astype(int)
        residual = np.rint(1000 * np.clip(residuals.residual_px[here], -99, 99)).astype(int)
        stars = np.c_[place, residual, residuals.used[here].astype(int)]
        error = residuals.attitude_error_arcsec[k]
        images.append(
            {
                'number': k + 1,
                'time': utc_text(int(residuals.image_time_ns[k])),
                'rms': None if math.isnan(rms[k]) else round(float(rms[k]), 4),
                'misfit': bool(residuals.image_misfit[k]),
                'tracker': [None if math.isnan(e) else round(float(e), 2) for e in error],
                'stars': stars.ravel().tolist(),
            }
        )
    return {
        'width': camera.width,
        'height': camera.height,
        'count': count,
        'images': images,
        # The length of a typical residual is a fiftieth of the width.
        'enlarge': round(float(np.clip(np.log10(0.02 * camera.width / typical_px), 0, 4)), 1),
    }


def picture(thumbnail: Thumbnail) -> Markup:
    """Data URL of a picture."""
    kind = 'image/jpeg' if thumbnail.name.endswith('.jpg') else 'image/png'
    # Safe as markup: base64 has no special characters.
    return Markup(f'data:{kind};base64,{base64.b64encode(thumbnail.encoded).decode("ascii")}')


def refused_images(
    counts: Mapping[str, int],
    observations: Sequence[StarObservations],
    thumbnails: Sequence[Thumbnail],
) -> list[Mapping[str, object]]:
    """For each reason its count, the refused images, and pictures of some of them."""
    pictures = {t.time_ns: t for t in thumbnails if not t.reason}
    groups: list[Mapping[str, object]] = []
    for reason, count in Counter(counts).most_common():
        images = [o for o in observations if o.refusal == reason]
        groups.append(
            {
                'reason': reason,
                'meaning': IMAGE_REFUSALS.get(reason, ''),
                'count': count,
                'images': [(utc_text(o.time_ns), o.detail) for o in images[:_LISTED_REFUSED]],
                'pictures': [
                    (picture(pictures[o.time_ns]), utc_text(o.time_ns), o.detail)
                    for o in images
                    if o.time_ns in pictures
                ],
            }
        )
    return groups


def _counts(observations: Sequence[StarObservations]) -> Counter[str]:
    """Refused stars of all images by reason."""
    counts: Counter[str] = Counter()
    for observed in observations:
        counts.update(observed.refused_stars)
    return counts


def star_marks(observations: Sequence[StarObservations]) -> list[tuple[str, str, str]]:
    """Colour, letter and reason of the marks of refused stars in the pictures."""
    return [
        (
            '#{:02x}{:02x}{:02x}'.format(*reversed(STAR_MARKS[reason].color)),
            LETTERS[STAR_MARKS[reason].shape],
            reason,
        )
        for reason, count in _counts(observations).items()
        if count and reason in STAR_MARKS
    ]


def refused_stars(
    observations: Sequence[StarObservations], thumbnails: Sequence[Thumbnail]
) -> list[Mapping[str, object]]:
    """
    For each reason, most frequent first: meaning, count, and pictures of some refused stars.

    Each picture has the stamp and the catalog number of its star.
    """
    by_time = {o.time_ns: o for o in observations}
    pictures = defaultdict(list)
    for one in (thumbnail for thumbnail in thumbnails if thumbnail.reason):
        number = star_of(one, by_time[one.time_ns]) if one.time_ns in by_time else None
        label = '' if number is None else str(number)
        pictures[one.reason].append((picture(one), utc_text(one.time_ns), label))
    return [
        {
            'reason': reason,
            'meaning': STAR_REFUSALS.get(reason, ''),
            'count': count,
            'pictures': pictures[reason],
        }
        for reason, count in _counts(observations).most_common()
        if count
    ]


def used_images(
    observations: Sequence[StarObservations], thumbnails: Sequence[Thumbnail]
) -> list[tuple[Markup, str, int]]:
    """Picture, stamp and number of stars of each used image."""
    stars = {o.time_ns: len(o) for o in observations if not o.refusal}
    return [
        (picture(t), utc_text(t.time_ns), stars[t.time_ns])
        for t in thumbnails
        if not t.reason and t.time_ns in stars
    ]
