# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Astropy's reading of the headers against catalog places that Astropy moves to the date."""

import dataclasses
from pathlib import Path

from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS
import numpy as np
import pytest

from starcal_ground import directions_icrf
from starcal_ground.bags.reader import read_observations
from starcal_ground.mission.export.export_formats import export
from starcal_ground.mission.export.image_attitude import attitude_by_stars
from starcal_ground.mission.export.request import Request
from starcal_ground.mission.export.wcs import _system
from starcal_ground.products import OBSERVATIONS_FILE, OBSERVATIONS_TOPIC
from starcal_ground.simulation.scenario import scenario, scene
from starcal_ground.undistortion import straight_camera
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.records import StarObservations, TemperatureTerms, TIMES
from starcal_ros.sky.catalog import load_catalog


@pytest.fixture(scope='module')
def images(tiny_products: Path) -> tuple[StarObservations, ...]:
    return tuple(read_observations([tiny_products / OBSERVATIONS_FILE], OBSERVATIONS_TOPIC))


@pytest.mark.filterwarnings('ignore::astropy.wcs.FITSFixedWarning')
def test_astropy_reprojects_the_stars_within_the_stated_residual(tiny, images, tmp_path) -> None:
    done = export(tiny, 'wcs', tmp_path, Request(observations=images))
    assert done.worst_px < 5e-3
    catalog = load_catalog()
    for image, name in zip(images, done.files, strict=True):
        header = fits.getheader(tmp_path / name)
        system = WCS(header)
        stars = catalog.select(catalog.rows_of(image.catalog_id)[0])
        at_epoch = SkyCoord(
            ra=stars.ra_rad * units.rad,
            dec=stars.dec_rad * units.rad,
            pm_ra_cosdec=stars.pm_ra_cosdec_rad_per_year * units.rad / units.yr,
            pm_dec=stars.pm_dec_rad_per_year * units.rad / units.yr,
            distance=10.0 * units.pc,  # only for its proper motion
            obstime=Time(stars.epoch_jyear, format='jyear'),
        )
        places = at_epoch.apply_space_motion(Time(image.time_ns / 1e9, format='unix'))
        pixels = np.stack(system.world_to_pixel(places), axis=-1)
        off = pixels - image.measured_px
        distance = np.linalg.norm(off, axis=1)
        # Outliers of the fit are no part of its residual: one star in thirty at most.
        inner = off[distance <= np.quantile(distance, 0.97)]
        assert np.sqrt(np.mean(inner**2)) <= header['STARRMS'] < 0.25
        # Both ways, over the whole detector.
        grid = pixel_grid(tiny.geometry.camera, 9, 9).reshape(-1, 2)
        there = system.pixel_to_world(*grid.T)
        assert np.abs(np.stack(system.world_to_pixel(there), axis=-1) - grid).max() < 1e-3
        # The inverse polynomials, which Astropy itself does not need.
        assert np.abs(system.sip_foc2pix(system.sip_pix2foc(grid, 0), 0) - grid).max() < 5e-3
        # Angles are those of the camera: aberration and catalog change them by 1e-4.
        u = there.cartesian.xyz.value.T
        of_camera = line_of_sight(tiny.geometry.camera, grid)
        assert u @ u[0] == pytest.approx(of_camera @ of_camera[0], abs=2e-4)


@pytest.mark.parametrize(
    ('floor_px', 'growth'),
    [(0.0, 0.0), (0.3, 0.0), (0.0, 1e-3)],
    ids=['as tiny', 'a floor of the centroids', 'a camera that breathes'],
)
def test_directions_of_an_image_are_those_of_its_stars_within_their_sigma(
    tiny, images, floor_px, growth
) -> None:
    rng, errors = np.random.default_rng(1), []
    found = dataclasses.replace(tiny, centroid_floor_px=max(floor_px, tiny.centroid_floor_px))
    middle = np.array([[tiny.geometry.camera.width, tiny.geometry.camera.height]]) / 2.0 - 0.5
    for index, image in enumerate(images):
        truth, size = scene(scenario('tiny'), index), 1.0 + growth * rng.choice([-1.0, 1.0])
        measured = middle + size * (image.measured_px - middle)
        measured += floor_px * rng.normal(size=measured.shape)
        pixels = pixel_grid(tiny.geometry.camera, 5, 5).reshape(-1, 2)
        seen = dataclasses.replace(image, measured_px=measured)
        towards, sigma_arcsec = directions_icrf(found, seen, pixels)
        of_image = middle + (pixels - middle) / size
        true = line_of_sight(scenario('tiny').truth.camera, of_image) @ truth.camera_from_icrf
        errors.append(np.linalg.norm(towards - true, axis=1) / (sigma_arcsec * ARCSECOND_RAD))
    # Ten attitudes and one camera: the mean square has some 15 degrees of freedom.  What an image
    # has of its own is largest in the corners, where a fifth of the pixels but few stars are.
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.8


def test_directions_are_those_of_pixels_by_three_stars(tiny, images) -> None:
    # A star beyond the detector, where the camera has no line of sight, is left out.
    far = dataclasses.replace(images[0], measured_px=images[0].measured_px.copy())
    far.measured_px[0] = 1e6
    assert np.isfinite(directions_icrf(tiny, far, [[320.0, 256.0]])[1]).all()
    beyond, sigma_arcsec = directions_icrf(tiny, images[0], [[-0.6, 10.0]])
    assert np.isnan(beyond).all() and np.isnan(sigma_arcsec).all()
    with pytest.raises(ValueError, match='fewer than three stars'):
        directions_icrf(tiny, images[0].select(np.arange(len(images[0])) < 2), [[0.0, 0.0]])
    # An image of unknown temperature has the camera of the calibration.
    thermal = TemperatureTerms(20.0, (1e-5,), (1e-6,))
    changing = dataclasses.replace(tiny, temperature=thermal)
    unknown = dataclasses.replace(images[0], temperature_degc=float('nan'))
    towards, _ = directions_icrf(changing, unknown, [[320.0, 256.0]])
    assert towards.tolist() == directions_icrf(tiny, unknown, [[320.0, 256.0]])[0].tolist()


@pytest.mark.filterwarnings('ignore::astropy.wcs.FITSFixedWarning')
def test_stars_in_a_quarter_of_an_image_bend_no_coordinates_in_the_others(tiny, images) -> None:
    camera, catalog = tiny.geometry.camera, load_catalog(None)
    corners = pixel_grid(camera, 2, 2).reshape(-1, 2)
    for whole in images:
        attitude = attitude_by_stars(tiny, whole)
        assert attitude is not None
        near = whole.select((whole.measured_px < [[320.0, 256.0]]).all(axis=1))
        there, here = (
            WCS(fits.Header(_system(tiny, image, attitude.icrf_from_camera, catalog).cards()))
            .pixel_to_world(*corners.T)
            .cartesian.xyz.value
            for image in (whole, near)
        )
        # Both follow the aberration to 0.02 px; a cubic through 39 stars was 0.37 px off.
        assert np.abs(there - here).max() * camera.parameters[0] < 0.05


def test_a_field_beyond_a_gnomonic_projection_is_named(tiny, images, tmp_path) -> None:
    # 87 degrees in a corner.
    wide = straight_camera(tiny.geometry.camera).replace(fx=25.0, fy=25.0)
    seen = line_of_sight(wide, images[0].measured_px)
    geometry = dataclasses.replace(tiny.geometry, camera=wide)
    asked = Request(observations=[dataclasses.replace(images[0], direction_icrf=seen)])
    with pytest.raises(ProductError, match='too wide for a gnomonic projection: use'):
        export(dataclasses.replace(tiny, geometry=geometry), 'wcs', tmp_path, asked)


def test_stars_of_another_catalog_are_named(tiny, images, tmp_path) -> None:
    strange = dataclasses.replace(images[0], catalog_id=-images[0].catalog_id - 10**7)
    with pytest.raises(ProductError, match=r'lacks \d+ of \d+ stars .* --catalog'):
        export(tiny, 'wcs', tmp_path, Request(observations=[strange]))
    with pytest.raises(ProductError, match='no image with stars'):
        export(tiny, 'wcs', tmp_path, Request())
    asked = Request(observations=images, catalog=tmp_path / 'gone.npz')
    with pytest.raises(ProductError, match='gone.npz: no such catalog; --catalog FILE'):
        export(tiny, 'wcs', tmp_path, asked)


def test_images_without_a_time_have_no_date(tiny, images, tmp_path) -> None:
    undated = dataclasses.replace(tiny, provenance={**tiny.provenance, TIMES: 'of the file'})
    dates = []
    for one, folder in ((tiny, tmp_path / 'a'), (undated, tmp_path / 'b')):
        folder.mkdir()
        export(one, 'wcs', folder, Request(observations=images[:1]))
        dates.append('DATE-AVG' in fits.getheader(folder / 'image0001.wcs'))
    assert dates == [True, False]
