# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Draw the pictures of the README and the documents: ``python -m docs.make_images [DIR]``.

All pictures are computed from the simulated campaign `small`, seed 1, and the bag in the
repository, so they can be redrawn after a change.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
import shutil
import subprocess
import tempfile

import cv2
import numpy as np
from numpy.typing import NDArray
import PIL.Image
from PIL.PngImagePlugin import PngInfo
import yaml

from starcal_ground.cli import main as cli
from starcal_ground.parameter_files import read_parameter_file
from starcal_ground.products import write_camera_info
from starcal_ground.report.detector_figures import (
    cell_counts,
    detector_map,
    distortion_vectors,
    star_cloud,
)
from starcal_ground.report.svg import sheet
from starcal_ground.simulation import rendering, simulated_bag
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats, Picture
from starcal_ros.assessment.observability import coverage
from starcal_ros.camera import distortion_px, pixel_grid
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.pipeline import observe as observing
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.annotation import annotate_reduced
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import Calibration, CameraGeometry, Ensemble, Image, StarObservations
from starcal_ros.sky.attitude import AttitudeHistory

FOLDER = Path(__file__).parent / 'images'
TINY = Path(__file__).parents[1] / 'bags' / 'tiny'
REPORT_SIZE = (1400, 960)  # the first screen, px
SHOWN_IMAGE = 12
CLOSE_UP_FIRST, CLOSE_UP_SIZE = (931, 541), (94, 74)  # enlarged until an offset of 3 px is seen


def setup_of(scenario: Scenario) -> Setup:
    """Setup of `starcal calibrate` for a simulated campaign."""
    with tempfile.TemporaryDirectory() as folder:
        camera, params = Path(folder, 'camera.yaml'), Path(folder, 'params.yaml')
        write_camera_info(scenario.prior.camera, camera)
        params.write_text(yaml.safe_dump(simulated_bag.parameters(scenario, str(camera))))
        return load_setup(read_parameter_file(params, ()))


def observe(scenario: Scenario, setup: Setup, image: Image, index: int) -> StarObservations:
    """Observations of one simulated image."""
    attitudes = AttitudeHistory()
    for sample in synthetic.attitude_samples(scenario, index):
        attitudes.add(sample.time_ns, sample)
    return observing.observe_next(image, attitudes, setup)[0]


def part_of(
    image: Image,
    observations: StarObservations,
    geometry: CameraGeometry,
    first: tuple[int, int],
    size: tuple[int, int],
    width: int,
) -> Picture:
    """Annotated part of an image, from a first pixel (u, v), drawn some pixels wide."""
    scale = width / size[0]
    shape = (width, round(size[1] * scale))

    def drawn(xy_px: NDArray[np.floating]) -> Floats:
        return np.asarray((xy_px - first + 0.5) * scale - 0.5, np.float64)

    u, v = first
    pixels = image.pixels[v : v + size[1], u : u + size[0]]
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST

    def inside(xy_px: Floats) -> NDArray[np.bool_]:
        return np.asarray(((xy_px > 0) & (xy_px < np.array(shape) - 1)).all(axis=1))

    measured, refused = drawn(observations.measured_px), drawn(observations.refused_px)
    left_out = inside(refused)
    reason = observations.refused_reason[left_out]
    shown = dataclasses.replace(
        observations.select(inside(measured)),
        measured_px=measured[inside(measured)],
        refused_catalog_id=observations.refused_catalog_id[left_out],
        refused_px=refused[left_out].astype(np.float32),
        refused_reason=reason,
        refused_stars={
            name: int(np.count_nonzero(reason == code))
            for code, name in enumerate(observations.refused_stars)
        },
    )
    fx, skew, fy = scale * geometry.camera.intrinsics[:3]
    cx, cy = drawn(geometry.camera.intrinsics[3:])
    camera = geometry.camera.replace(fx=fx, skew=skew, fy=fy, cx=cx, cy=cy)
    # No legend: it would cover stars.  The text below the picture explains the marks.
    return annotate_reduced(
        cv2.resize(pixels, shape, interpolation=way).astype(np.uint16),
        dataclasses.replace(shown, width=width, height=shape[1]),
        dataclasses.replace(geometry, camera=camera),
    )


def star_field(
    image: Image, observations: StarObservations, prior: CameraGeometry, file: Path
) -> None:
    """An image with its identified stars, and an enlarged part of it."""
    size = (prior.camera.width, prior.camera.height)
    whole = part_of(image, observations, prior, (0, 0), size, 810)
    close = part_of(image, observations, prior, CLOSE_UP_FIRST, CLOSE_UP_SIZE, 810)
    scale = 810 / size[0]
    corners = [
        tuple(round(scale * (a + b)) for a, b in zip(CLOSE_UP_FIRST, more, strict=True))
        for more in ((0, 0), CLOSE_UP_SIZE)
    ]
    cv2.rectangle(whole, corners[0], corners[1], (255, 255, 255), 1)
    height = min(len(whole), len(close))
    gap = np.full((height, 10, 3), 255, np.uint8)
    picture = np.hstack([whole[:height], gap, close[:height]])
    # Sixteen brightness levels look the same and compress better.
    cv2.imwrite(str(file), picture // 16 * 17, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def focal_plane(ensemble: Ensemble, setup: Setup, file: Path) -> None:
    """The estimated distortion and the star positions it was estimated from."""
    calibration = solve.solve(ensemble, setup)
    camera = calibration.geometry.camera
    stars = np.concatenate([observed.measured_px for observed in ensemble.images])
    length_px = np.hypot(*distortion_px(camera, pixel_grid(camera, 60, 48)).T).reshape(48, 60)
    drawn = sheet(
        [
            [distortion_vectors(camera).svg, detector_map(length_px, camera, ' px')],
            [star_cloud(stars, camera), cell_counts(coverage(ensemble, camera), camera).svg],
        ],
        f'distortion; {calibration.stars_used} stars in {calibration.images_used} images',
    )
    file.write_text(drawn.document())


def report_page(file: Path) -> None:
    """Top of the small bag's report in a browser."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = ['calibrate', str(TINY), '--params', str(TINY / 'params.yaml'), '-o', folder]
        assert cli.main(arguments) == 0
        if draw_page(Path(folder) / 'report.html', file, REPORT_SIZE):
            describe(file, read_calibration(Path(folder) / 'calibration.json'))


def describe(file: Path, calibration: Calibration) -> None:
    """Write the numbers of a calibration into its picture, for the test that it is of today."""
    camera = calibration.geometry.camera
    shown = dict(zip(camera.parameter_names, camera.parameters, strict=True))
    shown['residual_rms_px'] = calibration.residual_rms_px
    text = PngInfo()
    text.add_text('Description', '; '.join(f'{name}={value:.9g}' for name, value in shown.items()))
    with PIL.Image.open(file) as picture:
        picture.save(file, pnginfo=text, optimize=True)


def draw_page(page: Path, file: Path, size: tuple[int, int]) -> bool:
    """Draw the top of a page as a browser shows it; False if chromium is not installed."""
    browser = next(filter(None, map(shutil.which, ('chromium', 'google-chrome'))), None)
    if browser is None:
        print(f'{file.name}: not drawn, chromium is not installed')
        return False
    look = [
        '--headless',
        '--no-sandbox',
        '--disable-gpu',
        '--disable-background-networking',
        '--hide-scrollbars',
        f'--window-size={",".join(map(str, size))}',
        f'--screenshot={file.resolve()}',
        page.resolve().as_uri(),
    ]
    subprocess.run([browser, *look], check=True, capture_output=True)
    return True


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description='Draw the pictures of the documents.')
    parser.add_argument('folder', nargs='?', type=Path, default=FOLDER, metavar='DIR')
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    scenario = synthetic.scenario('small')
    setup = setup_of(scenario)
    ensemble = Ensemble()
    for index, image in enumerate(rendering.images(scenario)):
        observations = observe(scenario, setup, image, index)
        ensemble = ensemble.add(observations)
        if index == SHOWN_IMAGE:
            star_field(image, observations, setup.prior, folder / 'star_field.png')
    focal_plane(ensemble, setup, folder / 'focal_plane.svg')
    report_page(folder / 'report.png')


if __name__ == '__main__':
    main()
