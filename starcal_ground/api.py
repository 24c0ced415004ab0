# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibration from Python, without ROS: from arrays and from bags.

A calibration from arrays or from a bag is the one that ``starcal calibrate`` and the nodes give
from the same observations, with the same options.  BLAS runs on one thread meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import hashlib
from pathlib import Path
import tempfile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcal_ground import campaign, written_files
from starcal_ground.bags.topics import Topics
from starcal_ground.images.first_setup import Given, source_of
from starcal_ground.images.image_series import FileFacts
from starcal_ground.parameter_files import read_values
from starcal_ground.products import inputs_of
from starcal_ground.residuals import Residuals, solve_with_residuals
from starcal_ground.source_diagnosis import calibrated
from starcal_ros.arrays import Floats
from starcal_ros.assessment.gate import GateOptions
from starcal_ros.camera import CameraModel
from starcal_ros.errors import OptionError
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.formats.products import product_files
from starcal_ros.options import names_of, unknown_option
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.record_fields import check_shape, fields_of, plain_record, read_record, read_value
from starcal_ros.records import Calibration, CameraGeometry, StarObservations


def observations_of(
    camera: CameraModel,
    time_ns: int,
    measured_px: ArrayLike,
    covariance_px2: ArrayLike,
    direction_icrf: ArrayLike,
    icrf_from_star_tracker_xyzw: ArrayLike,
    catalog_id: ArrayLike | None = None,
    temperature_degc: float = float('nan'),
    star_tracker_rate_rad_s: ArrayLike = (float('nan'),) * 3,
    velocity_sigma_m_s: float = float('nan'),
    star_tracker_rate_sigma_rad_s: ArrayLike = (float('nan'),) * 3,
) -> StarObservations:
    """
    Observations of the n stars of one image, from arrays.

    Parameters
    ----------
    camera : CameraModel
        Gives the size of the image.
    time_ns : int
        Middle of the exposure, since the Unix epoch; different for each image.
    measured_px : (n, 2)
        Centroids (u, v); the centre of the first pixel is (0, 0).
    covariance_px2 : (n, 2, 2) or (2, 2)
        Covariance of each centroid, or one for all.
    direction_icrf : (n, 3)
        Unit vectors towards the stars at that time, in ICRF axes, corrected for proper motion and
        for the aberration of light.
    icrf_from_star_tracker_xyzw : (4,)
        Attitude of the star tracker at that time, unit quaternion, scalar last.
    catalog_id : (n,) int, optional
        The same number for the same star in every image, so that a star with a wrong direction is
        found.  Without it, stars of exactly equal directions are taken as the same.
    temperature_degc : float
        Temperature of the camera; NaN if not measured.
    star_tracker_rate_rad_s, star_tracker_rate_sigma_rad_s : (3,)
        Angular rate at that time about the axes of the star tracker, and its 1-sigma; NaN if not
        known.  Without one in any image, what a camera can turn while it is read out is in the
        sigma: state it, or ``shutter='global'``.
    velocity_sigma_m_s : float
        1-sigma of each component of the velocity of the observer in ``direction_icrf``; NaN: not
        known.

    Returns
    -------
    StarObservations
        Magnitude, flux and signal-to-noise ratio are NaN: the estimate does not use them.

    Raises
    ------
    ValueError
        For an array of the wrong shape, a number that is not finite, a vector that is not of unit
        length or a covariance that is not positive definite; the text names the argument.

    Examples
    --------
    >>> import numpy as np, starcal_ground
    >>> pinhole = [2000, 0, 2000, 511.5, 383.5, 0, 0, 0, 0, 0]
    >>> camera = starcal_ground.CameraModel(1024, 768, pinhole)
    >>> towards = np.array([[0.0, 0.0, 1.0], [0.0, 0.1, np.sqrt(0.99)]])  # (n, 3), ICRF
    >>> stars = starcal_ground.observations_of(
    ...     camera, 1_700_000_000_000_000_000, [[511.4, 383.6], [511.6, 584.4]],
    ...     0.01 * np.eye(2), towards, [0, 0, 0, 1])
    >>> len(stars), stars.covariance_px2[0].tolist()  # uu, uv, vv
    (2, [0.01, 0.0, 0.01])
    """
    # First: a wrong number of rows is then named as that of another argument.
    of_pixels = fields_of(StarObservations)['measured_px']
    pixels = read_value(of_pixels, np.asarray(measured_px), 'measured_px', {})
    n = len(pixels)
    covariance = np.asarray(covariance_px2, np.float64)
    if covariance.shape[-2:] != (2, 2):
        raise ValueError(f'covariance_px2: shape {covariance.shape} is not (n, 2, 2) or (2, 2)')
    rows = covariance[..., [0, 0, 1], [0, 1, 1]]
    identifiers = np.zeros(n, np.int64) if catalog_id is None else np.asarray(catalog_id)
    check_shape(identifiers.shape, (n,), 'catalog_id', {})
    unknown = np.full(n, np.nan, np.float32)
    stars = read_record(
        StarObservations,
        {
            **plain_record(StarObservations.of_image(time_ns, (camera.width, camera.height))),
            'icrf_from_star_tracker_xyzw': np.asarray(icrf_from_star_tracker_xyzw),
            'catalog_id': identifiers,
            'direction_icrf': np.asarray(direction_icrf),
            'magnitude': unknown,
            'measured_px': pixels,
            'covariance_px2': np.tile(rows, (n, 1)) if rows.ndim == 1 else rows,
            'flux_dn': unknown,
            'snr': unknown,
            'temperature_degc': temperature_degc,
            'star_tracker_rate_rad_s': np.asarray(star_tracker_rate_rad_s),
            'star_tracker_rate_sigma_rad_s': np.asarray(star_tracker_rate_sigma_rad_s),
            'velocity_sigma_m_s': velocity_sigma_m_s,
        },
    )
    uu, uv, vv = stars.covariance_px2.T
    if not ((uu > 0) & (uu * vv > uv**2) & np.isclose(uv, covariance[..., 1, 0])).all():
        raise ValueError('covariance_px2: not symmetric and positive definite')
    directions = _unit(stars.direction_icrf)
    return dataclasses.replace(
        stars,
        icrf_from_star_tracker_xyzw=_unit(stars.icrf_from_star_tracker_xyzw),
        catalog_id=_identifiers(directions) if catalog_id is None else stars.catalog_id,
        direction_icrf=directions,
    )


def calibrate(
    images: Iterable[StarObservations], prior: CameraGeometry, **options: object
) -> Calibration:
    """
    Calibration of camera and alignment from the observations of several images.

    Parameters
    ----------
    images : iterable of StarObservations
        As `observations_of` returns them.
    prior : CameraGeometry
        Camera and alignment to start from; parameters that are not estimated keep these values.
    **options
        Fields of `CalibrationOptions` and `GateOptions` by name, such as ``method``, ``estimate``
        or ``star_tracker_sigma_arcsec``; parameter files have the same names.

    Returns
    -------
    Calibration
        ``geometry`` has the camera and the alignment, ``sigma`` their 1-sigma; ``accepted`` and
        ``reasons`` are the verdict of the gate.

    Raises
    ------
    OptionError
        For an unknown option or a bad value.
    TooFewObservations
        When the images do not determine the parameters to be estimated.

    Examples
    --------
    Five images of 100 stars, whose camera has a focal length 0.5 % shorter than the prior:

    >>> import numpy as np, starcal_ground
    >>> from scipy.spatial.transform import Rotation
    >>> pinhole = [2000, 0, 2000, 511.5, 383.5, 0, 0, 0, 0, 0]
    >>> camera = starcal_ground.CameraModel(1024, 768, pinhole)
    >>> truth = starcal_ground.CameraGeometry(camera, [0, 0, 0, 1])
    >>> prior = starcal_ground.CameraGeometry(camera.replace(fx=2010, fy=2010), [0, 0, 0, 1])
    >>> noise, images = np.random.default_rng(1), []
    >>> for k in range(5):
    ...     pixels = noise.uniform((0, 0), (1023, 767), (100, 2))
    ...     icrf_from_camera = Rotation.from_rotvec([0, 0.2 * k, 0])
    ...     images.append(starcal_ground.observations_of(
    ...         camera, k, pixels + noise.normal(0, 0.1, pixels.shape), 0.01 * np.eye(2),
    ...         icrf_from_camera.apply(starcal_ground.lines_of_sight(truth, pixels)),
    ...         icrf_from_camera.as_quat()))
    >>> calibration = starcal_ground.calibrate(images, prior)
    >>> print(calibration.accepted, calibration.geometry.camera.parameters[0].round())
    True 2000.0
    """
    return calibrate_with_residuals(images, prior, **options)[0]


def calibrate_with_residuals(
    images: Iterable[StarObservations], prior: CameraGeometry, **options: object
) -> tuple[Calibration, Residuals]:
    """
    The calibration of `calibrate`, and its residuals by star and image.

    Examples
    --------
    >>> import starcal_ground
    >>> from starcal_ground.bags.reader import read_observations
    >>> images = list(read_observations(['out/observations.mcap'], '/observations'))
    >>> prior = starcal_ground.read_calibration('out').geometry
    >>> calibration, residuals = starcal_ground.calibrate_with_residuals(images, prior)
    >>> bool(residuals.residual_px[residuals.used].std() < 0.2)  # measured minus predicted
    True
    """
    known = names_of(CalibrationOptions, GateOptions)
    for name in options:
        if name not in known:
            raise OptionError(unknown_option(name, known))
    setup = load_setup(options, prior=prior)
    # The caller has looked the stars up: the bundled catalog has no part in the result.
    none = dataclasses.replace(setup.catalog.select(slice(0)), digest='')
    setup, ensemble = dataclasses.replace(setup, catalog=none), campaign.ensemble_of(images, setup)
    return solve_with_residuals(ensemble, setup)


def calibrate_bag(
    bags: Path | str | Sequence[Path | str],
    params: Path | str,
    *,
    image_topic: str = '',
    attitude_topic: str = '',
    velocity_topic: str = '',
    temperature_topic: str = '',
    observations_topic: str = '',
) -> Calibration:
    """
    Calibration from MCAP bags, as by ``starcal calibrate``; nothing is written.

    Bags without attitudes give the camera alone: `starcal_ground.calibrate_images`.

    Parameters
    ----------
    bags : path or sequence of paths
        Files or folders of bags.
    params : path
        ROS parameter file with the prior camera, the prior alignment and all other options; what
        it does not state is found by the stars.
    image_topic, attitude_topic, velocity_topic, temperature_topic, observations_topic : str
        Needed where a bag has more than one topic of the type.

    Raises
    ------
    StarcalError
        One line that names the cause: a bag, an option, a file or too few observations.

    Examples
    --------
    >>> import starcal_ground
    >>> calibration = starcal_ground.calibrate_bag('bags/tiny', 'bags/tiny/params.yaml')
    >>> calibration.images_used, calibration.residual_rms_px < 0.2
    (10, True)
    """
    paths = [Path(bag) for bag in ([bags] if isinstance(bags, (str, Path)) else bags)]
    requested = Topics(
        image=image_topic,
        attitude=attitude_topic,
        velocity=velocity_topic,
        temperature=temperature_topic,
        observations=observations_topic,
    )
    given = Given(paths, requested, read_values(Path(params)), Path(params))
    if given.is_by_stars:
        raise OptionError(f'{paths[0]}: no attitudes; starcal_ground.calibrate_images needs none')
    return _calibrated(given)


def calibrate_images(
    images: Path | str | Sequence[Path | str],
    *,
    image_topic: str = '',
    times: Mapping[str, int] | None = None,
    flip: str = '',
    **options: object,
) -> Calibration:
    """
    Calibration of a camera from images of the sky alone; nothing is written.

    Parameters
    ----------
    images : path or sequence of paths
        FITS, JPEG, PNG or TIFF files, folders of them, or patterns; or MCAP bags, whose attitudes
        are not used.
    image_topic : str
        Needed where a bag has more than one topic of images.
    times : mapping, optional
        Middle of the exposure, ns since the Unix epoch, of each image file by its name without
        folders; replaces that of the files, as ``--times``.
    flip : str
        ``left-right`` or ``top-bottom``: the image files are mirrored, as ``--flip``.
    **options
        Options of a parameter file by name.

    Returns
    -------
    Calibration
        Of the camera alone: ``has_alignment`` is False.

    Raises
    ------
    StarcalError
        One line that names the cause, and the images to take.

    Examples
    --------
    >>> import starcal_ground
    >>> calibration = starcal_ground.calibrate_images('bags/tiny')  # its attitudes are not used
    >>> calibration.has_alignment, calibration.images_used
    (False, 10)
    """
    paths = [Path(one) for one in ([images] if isinstance(images, (str, Path)) else images)]
    facts, topics = FileFacts(times, flip), Topics(image=image_topic)
    return _calibrated(Given(paths, topics, options, camera_alone=True, facts=facts))


def _calibrated(given: Given) -> Calibration:
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        source = campaign.chosen(source_of(given, Path(name), Path(name)))
        return calibrated(campaign.observe(source), inputs_of(source.files)).calibration


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """
    Write a ``calibration.json``, into a folder if the path is one.

    Raises
    ------
    ProductError
        When the file cannot be written.

    Examples
    --------
    >>> import starcal_ground
    >>> starcal_ground.write_calibration(starcal_ground.read_calibration('out'), 'copy.json')
    >>> starcal_ground.read_calibration('copy.json').images_used
    10
    """
    path = Path(path)
    file = path / product_files.CALIBRATION_FILE if path.is_dir() else path
    written_files.write_calibration(calibration, file)


def _unit(vectors: Floats) -> Floats:
    """Vectors of unit length to the last bit, from ones that are nearly so."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _identifiers(directions: Floats) -> NDArray[np.int64]:
    """A number (n,) for each direction, the same for equal ones in any image."""
    digests = (hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in directions)
    return np.frombuffer(b''.join(digests), np.int64)
