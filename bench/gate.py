# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The gate: rates of refused good campaigns and accepted spoilt campaigns.

Star fields of the paper's camera with all their errors drawn, as in `python -m studies`; then the
same with one thing wrong.  The limits are the defaults.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bench.frames import load_set_up
from bench.table import Table
from starcal_ground.simulation.scenario import scenario
from starcal_ros.assessment.observability import map_error_px
from starcal_ros.camera import project
from starcal_ros.errors import TooFewObservations
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from studies.trials import draw_star_field, observe, pointing_error_arcsec, StarField

SIZES = ((6, 80), (12, 30), (12, 80), (30, 80))  # number of images, stars per image
TRACKER_ARCSEC = (5.0, 20.0, 40.0)
OUTLIER_SHARE = 0.01
GOOD, SPOILT = 200, 40  # campaigns per size, per case


@dataclass(frozen=True)
class Spoil:
    """Mistakes in the field of stars and in each of its observations; share of wrong stars."""

    field: Callable[[StarField, np.random.Generator], StarField] = lambda field, rng: field
    image: Callable[[StarObservations], StarObservations] = lambda image: image
    outlier_share: float = OUTLIER_SHARE


def run(quick: bool) -> Iterator[Table]:
    """Test good campaigns of several sizes, then spoilt ones."""
    setup = load_set_up(scenario('paper'))
    good = Table(
        'Good campaigns and the gate with its default limits',
        ('images', 'stars each', 'campaigns', 'refused'),
    )
    for images, stars in SIZES:
        count = 10 if quick else GOOD
        judged = [_judged(setup, images, stars, k, Spoil()) for k in range(count)]
        for k, (reasons, _) in enumerate(judged):
            if reasons:
                print(f'refused: {images} x {stars}, {k}: {reasons}')
        good.add(images, stars, count, sum(bool(reasons) for reasons, _ in judged))
    yield good
    spoilt = Table(
        'Spoilt campaigns of 12 images of 80 stars and the gate with its default limits',
        ('what is wrong', 'campaigns', 'refused', 'let through: worst error px', 'by'),
        notes=[
            'error: of the lines of sight of what was let through against the truth, RMS over',
            'the detector, px; of a truth that changes, against the half that is farther off.',
        ],
    )
    for name, spoil in CASES.items():
        count = 5 if quick else SPOILT
        judged = [_judged(setup, 12, 80, k, spoil) for k in range(count)]
        let_through = [error_px for reasons, error_px in judged if not reasons]
        by = Counter(reason for reasons, _ in judged for reason in reasons).most_common(3)
        worst = max(0.0, *let_through) if let_through else None
        refused = count - len(let_through)
        spoilt.add(name, count, refused, worst, ', '.join(f'{n} {reason}' for reason, n in by))
    yield spoilt


def _judged(
    setup: Setup, images: int, stars: int, k: int, spoil: Spoil
) -> tuple[list[str], float]:
    """Names of the failed checks, and error of a campaign, px."""
    rng = np.random.default_rng([images, stars, k])
    tracker_arcsec = TRACKER_ARCSEC[k % len(TRACKER_ARCSEC)]
    field = draw_star_field(rng, images, stars)
    seen = observe(spoil.field(field, rng), tracker_arcsec, spoil.outlier_share)
    ensemble = Ensemble(tuple(map(spoil.image, seen.images)))
    assumed_arcsec = (tracker_arcsec,) * 3
    options = dataclasses.replace(setup.calibration, star_tracker_sigma_arcsec=assumed_arcsec)
    setup = dataclasses.replace(setup, prior=field.prior, calibration=options)
    try:
        found = solve.solve(ensemble, setup)[0]
    except TooFewObservations:
        return ['cannot be solved'], np.nan
    names = [check.option or check.note for check in found.gate if check.passed is False]
    focal_px = float(field.truth.camera.parameters[0])
    pointing_px = pointing_error_arcsec(found.geometry, field.truth) * np.pi / 648000 * focal_px
    error_px = max(pointing_px, map_error_px(found.geometry.camera, field.truth.camera))
    return names, error_px


def _seen_by(field: StarField, truth: CameraGeometry, rows: slice) -> StarField:
    """Field with some images taken with another camera or mounting."""
    before, after = (
        Rotation.from_quat(one.star_tracker_from_camera_xyzw) for one in (field.truth, truth)
    )
    camera_from_icrf = after.inv() * (before * field.camera_from_icrf)
    directions = np.einsum('mij,mnj->mni', camera_from_icrf.as_matrix(), field.direction_icrf)
    pixels = field.pixel_px.copy()
    pixels[rows] = project(truth.camera, directions[rows])
    return dataclasses.replace(field, pixel_px=pixels)


def _turned(geometry: CameraGeometry, arcsec: float, rng: np.random.Generator) -> CameraGeometry:
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(arcsec * np.pi / 648000 * axis / np.linalg.norm(axis))
    alignment = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw) * rotation
    return dataclasses.replace(geometry, star_tracker_from_camera_xyzw=alignment.as_quat())


def _focus_drifts(field: StarField, rng: np.random.Generator) -> StarField:
    """Focal length drifts by 0.3 % from the first image to the last."""
    for k in range(len(field.pixel_px)):
        factor = 1 + 3e-3 * k / (len(field.pixel_px) - 1)
        camera = field.truth.camera
        fx, skew, fy = camera.intrinsics[:3] * factor
        moved = dataclasses.replace(field.truth, camera=camera.replace(fx=fx, skew=skew, fy=fy))
        field = _seen_by(field, moved, slice(k, k + 1))
    return field


def _alignment_jumps(field: StarField, rng: np.random.Generator) -> StarField:
    half = slice(len(field.pixel_px) // 2, None)
    field = _seen_by(field, _turned(field.truth, 180.0, rng), half)
    return field


def _two_alignments(field: StarField, rng: np.random.Generator) -> StarField:
    other = _turned(field.truth, 1800.0, rng)
    for k in rng.permutation(len(field.pixel_px))[::2]:
        field = _seen_by(field, other, slice(k, k + 1))
    return field


def _attitude_inverted(image: StarObservations) -> StarObservations:
    xyzw = image.icrf_from_star_tracker_xyzw * [-1, -1, -1, 1]
    return dataclasses.replace(image, icrf_from_star_tracker_xyzw=xyzw)


def _equinox_of_date(field: StarField, rng: np.random.Generator) -> StarField:
    """Catalog directions of equinox 2026 used as ICRF: 26 years at 50.3 arcsec."""
    obliquity = Rotation.from_euler('x', 23.44, degrees=True)
    along_ecliptic = Rotation.from_euler('z', 26 * 50.3 / 3600, degrees=True)
    precession = obliquity * along_ecliptic * obliquity.inv()
    turned = precession.apply(field.direction_icrf.reshape(-1, 3))
    turned = turned.reshape(field.direction_icrf.shape)
    return dataclasses.replace(field, direction_icrf=turned)


def _old_places(field: StarField, rng: np.random.Generator) -> StarField:
    """No proper motion since 1950: 76 years of 50 mas per axis, as for bright stars."""
    motion_rad = rng.normal(0.0, 76 * 0.05 * np.pi / 648000, field.direction_icrf.shape)
    moved = field.direction_icrf + motion_rad
    moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
    return dataclasses.replace(field, direction_icrf=moved)


def _focal_scaled(field: StarField, rng: np.random.Generator) -> StarField:
    """Pixels of an image scaled by 5 % about the principal point."""
    camera = field.truth.camera
    center = camera.intrinsics[3:]
    pixels = center + 1.05 * (field.pixel_px - center)
    return dataclasses.replace(field, pixel_px=pixels)


def _mirrored(field: StarField, rng: np.random.Generator) -> StarField:
    """Image mirrored left to right."""
    pixels = field.pixel_px.copy()
    pixels[..., 0] = field.truth.camera.width - 1 - pixels[..., 0]
    return dataclasses.replace(field, pixel_px=pixels)


def _one_corner(image: StarObservations) -> StarObservations:
    """Stars only in one quarter of the detector."""
    middle = np.array([image.width / 2, image.height / 2])
    return image.select(np.all(image.measured_px < middle, axis=1))


CASES: dict[str, Spoil] = {
    'focal length drifts by 0.3 %': Spoil(_focus_drifts),
    'alignment jumps by 180 arcsec halfway': Spoil(_alignment_jumps),
    'half of the images, random, rotated by 0.5 deg': Spoil(_two_alignments),
    'attitude of the wrong direction': Spoil(image=_attitude_inverted),
    'catalog of the wrong equinox': Spoil(_equinox_of_date),
    'no proper motion for 76 years': Spoil(_old_places),
    'image scaled by 5 %': Spoil(_focal_scaled),
    'image mirrored': Spoil(_mirrored),
    '40 % of the stars misidentified': Spoil(outlier_share=0.4),
    'stars in one corner only': Spoil(image=_one_corner),
}
