# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Source Extractor and SCAMP: one distortion of degree 3 and linear terms of each image.

The median over the images is the camera.  The settings are not tuned.
"""

from __future__ import annotations

import math
from pathlib import Path
import resource
import shutil
import subprocess
import tempfile

import numpy as np
from scipy.spatial.transform import Rotation

from bench.frames import earth_velocity_m_s, history
from bench.peers.campaigns import Campaign, Result
from starcal_ros.arrays import Floats
from starcal_ros.camera import line_of_sight
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.records import Image
from starcal_ros.sky.astrometry import apparent_directions

INSTALLED = all(shutil.which(name) for name in ('source-extractor', 'scamp'))
_COLUMNS = (
    'XWIN_IMAGE YWIN_IMAGE ERRAWIN_IMAGE ERRBWIN_IMAGE ERRTHETAWIN_IMAGE'
    ' FLUX_AUTO FLUXERR_AUTO FLAGS FLUX_RADIUS'
)
_EXTRACT = '-CATALOG_TYPE FITS_LDAC -FILTER N -DETECT_THRESH 3 -ANALYSIS_THRESH 3'
_SOLVE = (
    '-ASTREF_CATALOG FILE -ASTREFCAT_NAME stars.ldac -ASTREFCENT_KEYS RA,DEC'
    ' -ASTREFERR_KEYS ERRA,ERRB,ERRT -ASTREFMAG_KEY MAG -ASTREFMAGERR_KEY MAGERR'
    ' -DISTORT_DEGREES 3 -SOLVE_PHOTOM N -CHECKPLOT_TYPE NONE -WRITE_XML N -SN_THRESHOLDS 5,50'
    ' -PIXSCALE_MAXERR 1.02 -POSANGLE_MAXERR 3 -NTHREADS 1'
)
_TIMEOUT_S = 300.0
_OFF_PX = 20.0  # least reach: principal point and star tracker
_STAR_SIGMA_DEG = 1e-3 / 3600.0


def whole(campaign: Campaign, off_rad: float) -> Result:
    """
    From images with attitudes off by up to an angle to lines of sight.

    Raises subprocess.SubprocessError where it fails or does not end.
    """
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        folder = Path(name)
        _write_stars(campaign, folder / 'stars.ldac')
        for k, (image, samples) in enumerate(campaign.frames):
            xyzw, _ = history(samples).at(image.time_ns, 1.0)
            _write_image(campaign, image, Rotation.from_quat(xyzw), folder / f'{k}.fits')
        pixel_arcsec = 1.0 / float(campaign.scenario.prior.camera.parameters[0]) / ARCSECOND_RAD
        off_arcmin = max(off_rad / ARCSECOND_RAD, _OFF_PX * pixel_arcsec) / 60.0
        # With its own choice of the resolution, 0, the match of some fields does not end.
        reach = [
            f'-POSITION_MAXERR {off_arcmin:.3f}',
            f'-MATCH_RESOL {2.0 * pixel_arcsec:.3f}',
            f'-CROSSID_RADIUS {3.0 * pixel_arcsec:.3f}',
        ]
        start_s = _children_s()
        _run(folder, len(campaign.frames), ' '.join(reach))
        took_s = _children_s() - start_s
        directions, stars = _lines_of_sight(campaign, folder)
    middle = np.median(directions, axis=0)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return Result('degree 3', middle, len(directions), stars, took_s)


def _write_stars(campaign: Campaign, path: Path) -> None:
    """Reference catalog of apparent places at the first image, as FITS LDAC."""
    from astropy.io import fits

    catalog, time_ns = campaign.setup.catalog, campaign.frames[0][0].time_ns
    place = apparent_directions(catalog, time_ns, earth_velocity_m_s(time_ns))
    count = len(catalog)
    columns = {
        'RA': np.degrees(np.arctan2(place[:, 1], place[:, 0])) % 360.0,
        'DEC': np.degrees(np.arcsin(place[:, 2])),
        'MAG': catalog.magnitude,
        **dict.fromkeys(('ERRA', 'ERRB'), np.full(count, _STAR_SIGMA_DEG)),
        **dict.fromkeys(('ERRT',), np.zeros(count)),
        **dict.fromkeys(('MAGERR',), np.full(count, 0.01)),
    }
    header = fits.Header({'NAXIS': 2}).tostring()
    cards = [fits.Column('Field Header Card', f'{len(header)}A', array=np.array([header]))]
    stars = [fits.Column(name, 'D', array=values) for name, values in columns.items()]
    fits.HDUList([
        fits.PrimaryHDU(),
        fits.BinTableHDU.from_columns(cards, name='LDAC_IMHEAD'),
        fits.BinTableHDU.from_columns(stars, name='LDAC_OBJECTS'),
    ]).writeto(path)  # fmt: skip


def _write_image(
    campaign: Campaign, image: Image, icrf_from_star_tracker: Rotation, path: Path
) -> None:
    """Image with the tangent plane of the prior camera and the attitude."""
    from astropy.io import fits

    prior = campaign.scenario.prior
    axes = (icrf_from_star_tracker * prior.star_tracker_from_camera).as_matrix()
    fx, _, fy, cx, cy = prior.camera.parameters[:5].tolist()
    ra, dec = math.atan2(axes[1, 2], axes[0, 2]), math.asin(axes[2, 2])
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    tangents = np.stack([east, np.cross(axes[:, 2], east)]) @ axes[:, :2] / [fx, fy]
    header = fits.Header({
        'CTYPE1': 'RA---TAN', 'CTYPE2': 'DEC--TAN', 'CRPIX1': cx + 1.0, 'CRPIX2': cy + 1.0,
        'CRVAL1': math.degrees(ra) % 360.0, 'CRVAL2': math.degrees(dec), 'RADESYS': 'ICRS',
        **{f'CD{i + 1}_{j + 1}': math.degrees(tangents[i, j]) for i in (0, 1) for j in (0, 1)},
    })  # fmt: skip
    fits.writeto(path, image.pixels.astype(np.float32), header)


def _run(folder: Path, images: int, reach: str) -> None:
    """Sources of the images, and SCAMP's solution of them; quiet."""
    (folder / 'columns').write_text('\n'.join(_COLUMNS.split()))
    (folder / 'empty').write_text('')
    for k in range(images):
        names = ['-c', 'empty', '-PARAMETERS_NAME', 'columns', '-CATALOG_NAME', f'{k}.ldac']
        _call(['source-extractor', f'{k}.fits', *names, *_EXTRACT.split()], folder)
    solve = ['scamp', *(f'{k}.ldac' for k in range(images)), '-c', 'empty', *_SOLVE.split()]
    _call([*solve, *reach.split()], folder)


def _children_s() -> float:
    """Processor time of the child processes so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _call(command: list[str], folder: Path) -> None:
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=_TIMEOUT_S)


def _lines_of_sight(campaign: Campaign, folder: Path) -> tuple[list[Floats], int]:
    """Lines of sight (n, 3) by each solution, turned to those of the prior; sources."""
    from astropy.io import fits
    from astropy.wcs import WCS

    nominal = line_of_sight(campaign.scenario.prior.camera, campaign.pixels)
    directions, stars = [], 0
    for path in sorted(folder.glob('*.head')):
        # Its comments are not in ASCII.
        cards = [line for line in path.read_bytes().split(b'\n') if line[8:9] == b'=']
        header = fits.Header.fromstring(b'\n'.join(cards).decode(), sep='\n')
        header['CTYPE1'], header['CTYPE2'] = 'RA---TPV', 'DEC--TPV'
        sky = np.radians(WCS(header).all_pix2world(campaign.pixels, 0))
        cosine = np.cos(sky[:, 1])
        seen = np.stack(
            [cosine * np.cos(sky[:, 0]), cosine * np.sin(sky[:, 0]), np.sin(sky[:, 1])], axis=-1
        )
        turn, _ = Rotation.align_vectors(nominal, seen)
        directions.append(turn.apply(seen))
        stars += len(fits.getdata(path.with_suffix('.ldac'), 2))
    return directions, stars
