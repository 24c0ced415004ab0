# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Attitudes and velocities from files of any format that is read here, and from solved images.

Of images the World Coordinate System is read: FITS headers, .wcs files of astrometry.net.  The
attitude is that of the camera, with its axis in the middle of the image.  The first row of a FITS
image is usually the lowest.  Read as an image of a camera, whose first row is the highest, it
mirrors the sky, so the order of its rows is reversed.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
from typing import Any
import warnings

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.images.photographs import ImageFile
from starcal_ground.mission.ingest import ccsds, kernels, mission_records
from starcal_ground.mission.ingest.mission_records import Attitudes, EME2000_NOTE, Velocities
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.errors import IngestError, needing
from starcal_ros.formats.image_files import is_fits
from starcal_ros.untrusted import regular_file


def attitudes(
    paths: Sequence[Path],
    star_tracker: str,
    at_ns: Sequence[int],
    images: Sequence[ImageFile] = (),
) -> Attitudes:
    """
    Attitudes from an AEM, a CSV table, SPICE kernels at stamps, or the WCS of images.

    Raises IngestError when the files cannot be read.
    """
    if all(map(kernels.is_kernel, paths)):
        return kernels.read_ck(paths, star_tracker, at_ns)
    if all(map(is_fits, paths)):
        return read_wcs(paths, images)
    path = _one(paths)
    if ccsds.is_ccsds(path):
        return ccsds.read_aem(path, star_tracker)
    return mission_records.read_attitudes(path)


def velocities(paths: Sequence[Path], spacecraft: str, at_ns: Sequence[int]) -> Velocities:
    """
    Velocities from an OEM or SPICE kernels at the stamps of the images, or from a CSV table.

    Raises IngestError when the files cannot be read.
    """
    if all(map(kernels.is_kernel, paths)):
        return kernels.read_spk(paths, spacecraft, at_ns)
    path = _one(paths)
    if ccsds.is_ccsds(path):
        return ccsds.read_oem(path, at_ns)
    return mission_records.read_velocities(path)


def _one(paths: Sequence[Path]) -> Path:
    if len(paths) > 1:
        raise IngestError(f'{paths[1]}: one file, unless all are SPICE kernels or all are FITS')
    return paths[0]


_GRID = 5  # points per side; the attitude fits them all, which averages the distortion


def read_wcs(paths: Sequence[Path], images: Sequence[ImageFile]) -> Attitudes:
    """
    Attitudes of the camera at the stamps of images, from files with the names of the images.

    Raises IngestError when an image has no such file, or a file has no celestial WCS.
    """
    by_name = {_name(path): path for path in paths}
    missing = [one.path for one in images if _name(one.path) not in by_name]
    if missing:
        raise IngestError(
            f'{missing[0]}: --attitude has no file of this name ({len(missing)} of'
            f' {len(images)} images): solve it, or leave it out of --images'
        )
    solved = [_attitude(by_name[_name(one.path)], one) for one in images]
    # Programs reverse the rows when they write FITS, so only FITS files can be affected.
    upward = {up for (_, up), one in zip(solved, images, strict=True) if is_fits(one.path)}
    if len(upward) > 1:
        raise IngestError(
            'some FITS images mirror the sky and others do not: import them separately'
        )
    notes = ['the attitudes come from the stars of the images: no alignment is estimated']
    if True in upward:
        notes.append('the rows of the FITS images count from the bottom: their order is reversed')
    return Attitudes(
        np.array([one.time_ns for one in images], np.int64),
        np.array([attitude.as_quat() for attitude, _ in solved]),
        (*notes, EME2000_NOTE),
        by_stars=True,
        rows_upward=upward == {True},
    )


def _name(path: Path) -> str:
    return Path(path.name.removesuffix('.gz').removesuffix('.fz')).stem


def _attitude(path: Path, image: ImageFile) -> tuple[Rotation, bool]:
    """The rotation ``icrf_from_camera``, and True if the rows of the image count upwards."""
    from starcal_ground.images.from_stars import pinhole  # brings the estimator, 0.2 s

    wcs = _celestial(path)
    middle = np.array([image.width - 1, image.height - 1]) / 2
    # A pixel to the right of the middle and one below it: size of a pixel, and handedness.
    about = _directions(wcs, middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), path)
    sides = about[1:] - about[0]
    turn = float(about[0] @ np.cross(*sides))
    camera = pinhole((image.width, image.height), 1.0 / math.sqrt(max(abs(turn), 1e-30)))
    pixels = pixel_grid(camera, _GRID, _GRID)
    rows_upward = turn < 0
    directions = _directions(wcs, pixels, path)
    lines = image.height - 1 - pixels[:, 1] if rows_upward else pixels[:, 1]
    seen = np.stack([pixels[:, 0], lines], axis=-1)
    rotation, _ = Rotation.align_vectors(directions, line_of_sight(camera, seen))
    return rotation, rows_upward


def _directions(wcs: Any, pixels: Any, path: Path) -> Any:
    """Unit vectors (n, 3) of pixels (n, 2), the centre of the first one (0, 0)."""
    directions = erfa.s2c(*np.radians(np.asarray(wcs.all_pix2world(pixels, 0)).T))
    if not np.isfinite(directions).all():
        raise IngestError(f'{path}: the WCS does not reach the corners of the image')
    return directions


def _celestial(path: Path) -> Any:
    """The first celestial WCS of a FITS file."""
    with needing('mission', IngestError, path):
        from astropy.io import fits
        from astropy.wcs import WCS
    try:
        with warnings.catch_warnings(), regular_file(path) as file:
            warnings.simplefilter('ignore')  # warnings about keywords that astropy repairs
            with fits.open(file, memmap=False) as units:
                systems = [WCS(unit.header) for unit in units if 'CTYPE1' in unit.header]
    except Exception as error:  # astropy raises any exception on a damaged file
        words = ' '.join(str(error).split())[:160]
        raise IngestError(f'{path}: no WCS can be read: {words}') from error
    wcs = next((one.celestial for one in systems if one.has_celestial), None)
    if wcs is None:
        raise IngestError(f'{path}: has no celestial WCS: solve the image first')
    # astropy adds a missing frame: FK5 if only an equinox is given, otherwise ICRS.
    axes, equinox = wcs.wcs.radesys, wcs.wcs.equinox
    kinds = [str(kind)[:2] for kind in wcs.wcs.ctype]
    if kinds != ['RA', 'DE'] or not (axes == 'ICRS' or (axes == 'FK5' and equinox == 2000.0)):
        raise IngestError(f'{path}: a WCS in {kinds[0]}, {axes} {equinox:g}: ICRS or J2000 only')
    return wcs
