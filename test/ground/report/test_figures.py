# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of residuals, of the detector and of the sky: numbers, scales, the projection."""

import dataclasses
import re

import numpy as np
import pytest

from starcal_ground.products import read_residuals, RESIDUALS_FILE
from starcal_ground.report import detector_figures, figures, svg
from starcal_ros.camera import CameraModel
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.records import CameraGeometry, refused_image, StarObservations


def test_means_in_bins_and_their_errors() -> None:
    x = np.repeat([0.5, 1.5, 2.5], [100, 9, 25])
    y = np.concatenate([np.tile([1.0, 3.0], 50), np.ones(9), np.full(25, -2.0)])
    centre, mean, error = figures._in_bins(x, y, np.arange(4, dtype=np.float64))
    assert centre.tolist() == [0.5, 2.5]  # nine values are too few
    assert mean.tolist() == [2.0, -2.0]
    assert error.tolist() == pytest.approx([0.1, 0.0])


def test_the_three_axes_of_a_star_tracker_share_the_axis_of_time(tiny_products) -> None:
    given = read_residuals(tiny_products / RESIDUALS_FILE)
    spread = np.random.default_rng(1).normal(size=given.attitude_error_arcsec.shape)
    found = dataclasses.replace(given, attitude_error_arcsec=spread * (2.0, 9.0, 90.0))
    chart = figures.alignment_in_time(found, (1.0, 10.0, 100.0))
    assert chart is not None
    axes = re.findall(r'<path d="M([\d.]+),[\d.]+V[\d.]+H([\d.]+)"', chart.svg.body)
    assert len(axes) == 3 and len(set(axes)) == 1


CAMERA = CameraModel(640, 512, np.array([1800.0, 0, 1800, 319.5, 255.5, -0.05, 0, 0, 0, 0]))


@pytest.mark.parametrize(('width', 'height'), [(640, 512), (2592, 2048), (400, 1600), (2000, 200)])
def test_arrows_have_a_scale_inside_the_canvas(width, height) -> None:
    camera = CameraModel(
        width, height, np.array([1800.0, 0, 1800, width / 2, height / 2, -0.05, 0, 0, 0, 0])
    )
    drawn = detector_figures.distortion_vectors(camera).svg.__html__()
    assert re.search(r'>scale: [\d.]+ px<', drawn)
    wide, high = map(float, re.findall(r'viewBox="0 0 (\d+) ([\d.]+)"', drawn)[0])
    tips = re.findall(rf'd="M([\d.]+),([\d.]+)L[^"]*Z" fill="{re.escape(svg.SERIES[1])}"', drawn)
    assert len(tips) == 1
    assert 0 < float(tips[0][0]) <= wide and 0 < float(tips[0][1]) < high


def test_outward_arrows_cover_no_number_of_the_axes() -> None:
    drawn = detector_figures.distortion_vectors(CAMERA.replace(k1=0.05)).svg
    tips = re.findall(
        rf'd="M([\d.]+),([\d.]+)L[^"]*Z" fill="{re.escape(svg.SERIES[0])}"', drawn.body
    )
    u, v = np.array(tips, dtype=float).T
    assert u.min() >= 46 and u.max() <= drawn.width - 2
    assert v.min() >= 18 and v.max() <= drawn.height - 32


def half_wave_along_u(amplitude_px: float) -> DetectorField:
    coefficients_px = np.zeros((2, term_count(640, 512, 1)))
    coefficients_px[0, 0] = amplitude_px
    return DetectorField(640, 512, 1, coefficients_px)


def test_the_scale_is_that_of_the_arrows() -> None:
    """The longest arrows, of 0.3 px along u, have 1.5 times the length of 0.2 px."""
    first_arrow_px = np.array([[19.5, 20.8]])
    field = half_wave_along_u(1.0)
    field = half_wave_along_u(0.3 / field.displacement_px(first_arrow_px)[0, 0])
    drawn = detector_figures.field_vectors(field, CAMERA).svg.body
    assert '>scale: 0.2 px<' in drawn
    arrow = r'd="M([\d.]+),[\d.]+L[\d.]+,[\d.]+" fill="none" stroke="{}"[^>]*/><path d="M([\d.]+),'
    lengths = {}
    for colour in svg.SERIES[:2]:
        first = re.findall(arrow.format(re.escape(colour)), drawn)[0]
        lengths[colour] = float(first[1]) - float(first[0])
    # The view box has one decimal.
    assert lengths[svg.SERIES[0]] == pytest.approx(1.5 * lengths[svg.SERIES[1]], abs=0.2)


def test_what_no_image_shows_and_a_flat_map_say_so_and_others_start_at_zero() -> None:
    drawn = detector_figures.field_vectors(half_wave_along_u(6e-4), CAMERA).svg.body
    assert '>less than 0.001 px everywhere<' in drawn and 'scale' not in drawn
    ideal = CAMERA.replace(k1=0.0)
    assert '>no displacement<' in detector_figures.distortion_vectors(ideal).svg.body
    nothing = detector_figures.detector_map(np.zeros((3, 3)), ideal, ' px')
    assert '>0 px everywhere<' in nothing.body
    flat = np.full((25, 25), 5.774)
    flat[0, 0] = 5.802
    assert '>flat within 0.48 %<' in detector_figures.detector_map(flat, CAMERA, '″').body
    steep = np.linspace(1.0, 8.0, 625, dtype=np.float64).reshape(25, 25)
    drawn = detector_figures.detector_map(steep, CAMERA, '″').body
    assert 'flat' not in drawn and '>0″<' in drawn and '>8″<' in drawn
    assert '>unknown<' in detector_figures.detector_map(np.full((3, 3), np.nan), CAMERA, '″').body


def test_the_projection_of_the_sky() -> None:
    """Hammer: x = -2 sqrt(2) cos(d) sin(a/2) / sqrt(1 + cos(d) cos(a/2)), of unit area scale."""
    root2 = np.sqrt(2.0)
    longitude_deg, latitude_deg = np.array([0.0, 0, 0, 90, 180]), np.array([0.0, 90, -90, 0, 0])
    x, y = detector_figures.hammer(np.radians(longitude_deg), np.radians(latitude_deg))
    quarter = -2 * root2 * np.sin(np.pi / 4) / np.sqrt(1 + np.cos(np.pi / 4))
    np.testing.assert_allclose(x, [0, 0, 0, quarter, -2 * root2], atol=1e-9)
    np.testing.assert_allclose(y, [0, root2, -root2, 0, 0], atol=1e-9)


def test_pointings_count_images_with_an_attitude() -> None:
    geometry = CameraGeometry(CAMERA, np.array([0.0, 0, 0, 1]))
    turned = np.array([0.0, np.sin(0.3), 0.0, np.cos(0.3)])
    seen = [
        StarObservations.of_image(1, (640, 512), icrf_from_star_tracker_xyzw=turned),
        refused_image(
            2, 640, 512, 'no_match', '', icrf_from_star_tracker_xyzw=turned, attitude_gap_s=0.5
        ),
        refused_image(3, 640, 512, 'no_attitude', ''),
    ]
    chart = detector_figures.pointings(seen, geometry)
    assert chart is not None and 'Footprints of 2 images' in chart.text
    # A footprint and its line in the legend.
    assert [chart.svg.body.count(colour) for colour in svg.SERIES[:2]] == [2, 2]
    assert detector_figures.pointings(seen[2:], geometry) is None
