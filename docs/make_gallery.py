# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Draw the pictures of docs/gallery.md: ``python -m docs.make_gallery [DIR]``.

Every picture is a simulated frame with an artificial fault, annotated by `starcal`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from docs.make_images import FOLDER, setup_of
from starcal_ground.simulation import rendering, scenario
from starcal_ros.arrays import Floats, Picture
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.annotation import annotate
from starcal_ros.records import Image, StarObservations
from starcal_ros.sky.attitude import AttitudeHistory
from starcal_ros.stars.hot_pixels import with_bad_pixels

SCENARIO = scenario.scenario('tiny')
PLAIN = setup_of(SCENARIO)
# The marks of fainter stars would cover the pictures.
SETUP = dataclasses.replace(
    PLAIN, identification=dataclasses.replace(PLAIN.identification, magnitude_limit=7.5)
)
SHAPE = (SCENARIO.truth.camera.height, SCENARIO.truth.camera.width)
FULL_DN = SCENARIO.detector.full_dn
FIELD = 7  # of some hundred stars, bright and faint
DRAWN_PX = (400, 320)
ABOUT_PX = 12  # half width of the picture of a star
ENLARGED = 7


def electrons(smear_px: float = 0.0, field: int = FIELD) -> Floats:
    """Mean signal of a field, its stars smeared along a line."""
    shown, psf_px = scenario.scene(SCENARIO, field), SCENARIO.detector.psf_sigma_px
    steps = max(1, round(4 * smear_px))
    mean = rendering.fixed_pattern(SCENARIO)
    for k in range(steps):
        moved = shown.pixel_px + ((k + 0.5) / steps - 0.5) * smear_px * np.array([0.8, 0.6])
        flux = shown.flux_electrons / steps
        mean = mean + rendering.star_electrons(moved, flux, psf_px, SHAPE)
    return mean


def expose(mean: Floats) -> NDArray[np.uint16]:
    """Frame with a mean signal and always the same noise."""
    pixels = rendering.expose(mean, SCENARIO.detector, np.random.default_rng(8))
    return pixels.astype(np.uint16)


def attitudes(field: int = FIELD, reported: int | None = None) -> AttitudeHistory:
    """Star tracker samples of a frame: the true attitude, or that of another field."""
    held = AttitudeHistory()
    told = scenario.attitude_samples(SCENARIO, field if reported is None else reported)
    for sample, at in zip(told, scenario.attitude_samples(SCENARIO, field), strict=True):
        held.add(at.time_ns, dataclasses.replace(sample, time_ns=at.time_ns))
    return held


def whole_frames() -> Mapping[str, tuple[Image, StarObservations]]:
    """Name of a picture -> frame and observations."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    time_ns, sound = SCENARIO.time_ns(FIELD), electrons()
    pixels, before = expose(sound), expose(electrons(field=FIELD - 1))
    half = SHAPE[0] // 2
    limb = np.where(np.hypot(u - 700.0, v - 560.0) < 450.0, 1e6, 0.0)
    lost, torn = pixels.copy(), before.copy()
    lost[half:] = 0
    torn[:half] = pixels[:half]
    frames = {
        'accepted': pixels,
        'accepted_mild_glare': expose(sound + 0.15 * u),
        'accepted_smear': expose(electrons(3.0)),
        'overexposed': expose(sound + limb),
        'glare': expose(sound + 2.0e3 * (1.0 + np.cos(np.hypot(u + 60.0, v + 60.0) / 40.0))),
        'incomplete_lost': lost,
        'incomplete_torn': torn,
        'no_stars': expose(rendering.fixed_pattern(SCENARIO)),
        'smeared': expose(electrons(25.0)),
    }
    found = {}
    earlier = Image(SCENARIO.time_ns(FIELD - 1), before)
    held = attitudes()
    _, track = observe.observe_next(earlier, held, SETUP, observe.Track(SETUP.prior))
    for name, spoilt in frames.items():
        image = Image(time_ns, spoilt)
        found[name] = (image, observe.observe_next(image, held, SETUP, track)[0])
    frozen = Image(time_ns, before)
    found['frozen'] = (frozen, observe.observe_next(frozen, held, SETUP, track)[0])
    image = Image(time_ns, pixels)
    jumped = attitudes(reported=FIELD + 1)
    found['no_match'] = (image, observe.observe_next(image, jumped, SETUP)[0])
    return found


def drawn(image: Image, observations: StarObservations) -> Picture:
    """A whole frame with its marks, at the size of the gallery."""
    small = cv2.resize(image.pixels, DRAWN_PX, interpolation=cv2.INTER_AREA)
    return annotate(Image(image.time_ns, np.asarray(small, np.uint16)), observations, SETUP.prior)


def spoilt_stars() -> tuple[Image, StarObservations]:
    """Frame with faults at single stars, and its observations."""
    plain = observe.observe_next(
        Image(SCENARIO.time_ns(FIELD), expose(electrons())), attitudes(), SETUP
    )[0]
    places = plain.measured_px[np.argsort(-plain.snr)]
    inside = ((places > 40) & (places < np.array([SHAPE[1], SHAPE[0]]) - 41)).all(axis=1)
    burnt, crossed, hot, moved = np.rint(places[inside][[3, 30, 40, 20]]).astype(int)
    mean = electrons()
    mean[burnt[1] - 3 : burnt[1] + 4, burnt[0] - 3 : burnt[0] + 4] += 1e6  # 49 pixels, of 40
    for k in range(-5, 6):
        mean[crossed[1] + k // 2, crossed[0] + k] += 600.0
    star = np.s_[moved[1] - 4 : moved[1] + 5, moved[0] - 4 : moved[0] + 5]
    mean[star] = np.roll(mean[star], 3, axis=1)
    bright = expose(mean)
    bright[hot[1], hot[0] + 1] += 60
    number = hot[1] * SHAPE[1] + hot[0] + 1
    hot_pixels = with_bad_pixels(SETUP.detector.hot, np.array([number], np.int64))
    detector = dataclasses.replace(SETUP.detector, hot=hot_pixels)
    known = dataclasses.replace(SETUP, detector=detector)
    image = Image(SCENARIO.time_ns(FIELD), bright)
    return image, observe.observe_next(image, attitudes(), known)[0]


def star_sheet(image: Image, observations: StarObservations) -> Picture:
    """The brightest star of each reason and a used one, enlarged."""
    magnitude = dict(zip(SETUP.catalog.id.tolist(), SETUP.catalog.magnitude, strict=True))
    brightness = np.array([magnitude[star] for star in observations.refused_catalog_id.tolist()])
    usable = observations.measured_px[np.argsort(-observations.snr)]
    cells = [_close_up(image, observations, 'used', np.rint(usable[12]).astype(int))]
    for code, (reason, places) in enumerate(observations.refused_places().items()):
        brightest = brightness[observations.refused_reason == code].argmin()
        cells.append(
            _close_up(image, observations, reason, np.rint(places[brightest]).astype(int))
        )
    blank = np.full_like(cells[0], 255)
    cells += [blank] * (-len(cells) % 4)
    rows = [np.hstack(cells[k : k + 4]) for k in range(0, len(cells), 4)]
    return np.asarray(np.vstack(rows), np.uint8)


def _close_up(
    image: Image, observations: StarObservations, reason: str, centre: NDArray[np.int_]
) -> Picture:
    """Pixels around a star with its mark, below the name of its reason."""
    side = 2 * ABOUT_PX + 1
    rim = (ABOUT_PX,) * 2
    background = round(observations.background_dn)
    around = np.pad(image.pixels, (rim, rim), constant_values=background)
    u, v = centre
    pixels: Any = around[v : v + side, u : u + side]
    size = (side * ENLARGED, side * ENLARGED)
    large = cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST)
    low, high = observations.background_dn - 2, observations.background_dn + 20
    level = np.clip((large.astype(float) - low) / (high - low), 0.0, 1.0)
    picture = cv2.cvtColor((40 + 215 * level).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    color = (80, 220, 80) if reason == 'used' else (60, 60, 255)
    middle = (size[0] // 2, size[1] // 2)
    cv2.circle(picture, middle, 5 * ENLARGED, color, 1, cv2.LINE_AA)
    picture = cv2.copyMakeBorder(picture, 24, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    text = reason.replace('_', ' ')
    cv2.putText(picture, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description='Draw the pictures of the gallery.')
    parser.add_argument('folder', nargs='?', type=Path, default=FOLDER, metavar='DIR')
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {f'gallery_{name}': drawn(*frame) for name, frame in whole_frames().items()}
    pictures['gallery_stars'] = star_sheet(*spoilt_stars())
    for name, picture in pictures.items():
        # Few brightness levels look the same and compress better.
        small = picture // 16 * 17 if name == 'gallery_glare' else picture // 48 * 51
        cv2.imwrite(str(folder / f'{name}.png'), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == '__main__':
    main()
