"""The whole flow as straight functions: what the nodes and the tool both call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import hashlib
import importlib.metadata
import json
import math
from pathlib import Path
from typing import Any, get_type_hints, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros import bag
from starcal_ros.acceptance import Candidate, GateOptions, judge, reasons_of
from starcal_ros.agreement import Difference, difference, halves
from starcal_ros.astrometry import SiteOptions
from starcal_ros.attitude import AttitudeHistory, AttitudeOptions
from starcal_ros.calibration import (
    CalibrationOptions,
    check_options,
    Estimate,
    estimate_calibration,
)
from starcal_ros.camera import zero_skew_fit
from starcal_ros.camera_info import read_camera_info
from starcal_ros.catalog import load_catalog, StarCatalog
from starcal_ros.centroiding import CentroidOptions, saturation_level
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ImageRefused, OptionError
from starcal_ros.fixed_pattern import (
    FixedPatternOptions,
    hot_in_dark,
    HotPixels,
    learn_hot_pixels,
    NO_HOT_PIXELS,
)
from starcal_ros.identification import IdentificationOptions, observe_stars, Shot, tracked
from starcal_ros.observability import (
    correlation,
    detector_maps,
    keep_most_informative,
    map_sigma_px,
    weakest_direction,
)
from starcal_ros.observability import ensemble_status as _ensemble_status
from starcal_ros.options import (
    check_value,
    from_mapping,
    holds_options,
    names_of,
    nearest,
    option,
    OptionValue,
)
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    Ensemble,
    EnsembleStatus,
    Halves,
    Image,
    refused_image,
    StarObservations,
)
from starcal_ros.removal import removal_study
from starcal_ros.residuals import Residuals, residuals_of
from starcal_ros.screening import Fingerprint, fingerprint, sample_rows, screen, ScreeningOptions
from starcal_ros.tracking import follow, Followed, following

Floats = NDArray[np.float64]
T = TypeVar('T')
OnImage = Callable[[Image, StarObservations, CameraGeometry], None]


@dataclass(frozen=True)
class SetupOptions:
    """Prior camera and alignment, frames, and the files that go with the camera."""

    camera_info_url: str = option(
        '', 'prior camera: a ROS camera YAML, file:// or package:// URL or a path'
    )
    prior_alignment: tuple[float, ...] = option(
        (0.0, 0.0, 0.0, 1.0),
        'prior orientation of the camera in the star tracker frame, quaternion x, y, z, w',
        low=-1.0,
        high=1.0,
        length=4,
    )
    star_tracker_frame: str = option('star_tracker', 'name of the star tracker frame')
    camera_frame: str = option('camera', 'name of the camera optical frame')
    catalog: str = option('', 'star catalog file; empty: the bundled one')
    dark_frame: str = option(
        '', "dark frame, a PNG or TIFF of the camera's size and depth, subtracted; empty: none"
    )


@dataclass(frozen=True)
class Setup:
    """Options of every stage, and what they name, loaded."""

    frames: SetupOptions
    attitude: AttitudeOptions
    site: SiteOptions
    screening: ScreeningOptions
    fixed_pattern: FixedPatternOptions
    centroid: CentroidOptions
    identification: IdentificationOptions
    calibration: CalibrationOptions
    gate: GateOptions
    prior: CameraGeometry
    catalog: StarCatalog
    dark: NDArray[np.uint8] | NDArray[np.uint16] | None
    dark_pedestal_dn: int = 0
    hot: HotPixels = NO_HOT_PIXELS

    def options(self) -> dict[str, OptionValue]:
        """Every option of every stage, by name."""
        return {
            name: value
            for group in _OPTION_GROUPS
            for name, value in dataclasses.asdict(getattr(self, group)).items()
        }


_OPTION_GROUPS: dict[str, type[Any]] = {
    name: kind for name, kind in get_type_hints(Setup).items() if holds_options(kind)
}
OPTION_CLASSES = tuple(_OPTION_GROUPS.values())


def load_setup(values: Mapping[str, object], others: Sequence[type] = ()) -> Setup:
    """
    Checked options with prior camera, catalog and dark frame loaded.

    ``others`` are option classes of the caller whose names the mapping may hold as well.

    Raises
    ------
    OptionError
        For a name nobody knows or a bad value.
    ProductError, CatalogError
        When the prior camera or the catalog cannot be read.
    """
    known = names_of(*OPTION_CLASSES, *others)
    for name in values:
        if name not in known and name != 'use_sim_time':
            raise OptionError(f'{name}: no such parameter{nearest(name, known)}')
    frames = from_mapping(SetupOptions, values)
    if not frames.camera_info_url:
        raise OptionError('camera_info_url: the prior camera must be given')
    camera = read_camera_info(frames.camera_info_url)
    quaternion = np.array(frames.prior_alignment)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        raise OptionError(
            f'prior_alignment: {list(frames.prior_alignment)} is not a unit quaternion'
        )
    identification = from_mapping(IdentificationOptions, values)
    calibration = from_mapping(CalibrationOptions, values)
    check_options(calibration)
    path = Path(frames.catalog) if frames.catalog else None
    fixed_pattern = from_mapping(FixedPatternOptions, values)
    dark = _read_dark(frames.dark_frame, camera.width, camera.height)
    return Setup(
        frames=frames,
        attitude=from_mapping(AttitudeOptions, values),
        site=from_mapping(SiteOptions, values),
        screening=from_mapping(ScreeningOptions, values),
        fixed_pattern=fixed_pattern,
        centroid=from_mapping(CentroidOptions, values),
        identification=identification,
        calibration=calibration,
        gate=from_mapping(GateOptions, values),
        prior=CameraGeometry(camera, quaternion / norm),
        catalog=load_catalog(path, identification.magnitude_limit),
        dark=dark,
        dark_pedestal_dn=0 if dark is None else int(np.median(dark)),
        hot=hot_in_dark(dark, fixed_pattern),
    )


def _read_dark(
    path: str, width: int, height: int
) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    if not path:
        return None
    dark = cv2.imread(path.removeprefix('file://'), cv2.IMREAD_UNCHANGED)
    if dark is None:
        raise OptionError(f'dark_frame: {path} is not an image file')
    if dark.shape != (height, width) or dark.dtype not in (np.uint8, np.uint16):
        raise OptionError(
            f'dark_frame: {path} is {dark.dtype} of shape {dark.shape}, '
            f'not one channel of {width} x {height}'
        )
    return dark.astype(np.uint8) if dark.dtype == np.uint8 else dark.astype(np.uint16)


def observe(
    image: Image,
    attitudes: AttitudeHistory,
    setup: Setup,
    geometry: CameraGeometry,
    velocity_m_s: Floats | None = None,
) -> StarObservations:
    """
    The stars of one image, or the record of why it is refused; never raises for a bad image.

    ``geometry`` is what the stars are predicted with: the prior or a calibration in force.
    ``velocity_m_s`` (3,) is the observer's barycentric velocity, ICRF axes; None: the Earth's.
    """
    return observe_next(image, attitudes, setup, Track(geometry), velocity_m_s)[0]


def _without_dark(image: Image, setup: Setup) -> Image:
    """The image less the dark frame, kept positive by the dark frame's own median."""
    pixels, dark = image.pixels, setup.dark
    if dark is None:
        return image
    if dark.dtype != pixels.dtype:
        raise ImageRefused('bad_encoding', f'{pixels.dtype} image, the dark frame is {dark.dtype}')
    # Noise below the dark level must not be cut off at zero: it would bias the background.
    level = pixels.astype(np.int32) - dark + setup.dark_pedestal_dn
    # What is saturated stays at the end of the range, where it is known as such.
    peak = int(pixels.max())
    level[pixels >= (saturation_level(pixels, setup.centroid) or np.inf)] = peak
    level = np.clip(level, 0, peak)
    if pixels.dtype == np.uint8:
        return Image(image.time_ns, level.astype(np.uint8))
    return Image(image.time_ns, level.astype(np.uint16))


_IMAGES_OF_A_RESTART = 3  # two images may have changed places on their way; three do not


@dataclass(frozen=True)
class Track:
    """
    Where a sequence of images stands.

    ``geometry`` is what an image is searched with; ``latest_ns`` stamps the last one used.
    ``followed`` is what the images so far have shown, with which the next is measured without a
    search; None before the first.  ``behind`` images in a row, the last of them at ``behind_ns``,
    were stamped before the last one used.  ``seen`` is the last frame of all, used or not,
    which a stuck camera shows again; ``hot`` the hot pixels found so far.
    """

    geometry: CameraGeometry
    latest_ns: int | None = None
    followed: Followed | None = None
    behind: int = 0
    behind_ns: int = 0
    seen: Fingerprint | None = None
    hot: HotPixels | None = None


def observe_next(
    image: Image,
    attitudes: AttitudeHistory,
    setup: Setup,
    track: Track,
    velocity_m_s: Floats | None = None,
    temperature_degc: float = math.nan,
) -> tuple[StarObservations, Track]:
    """
    The stars of the next image of a sequence, and where the sequence stands then.

    A sequence starts with the prior, or with the calibration in force.  An image stamped at or
    before one that was used is refused; a refused image moves nothing, so that one wrong stamp
    costs one image.  The third such image in a row, in order among themselves, is believed: a
    clock was set back, or a recording plays again.  The sequence starts anew with it.  The pixels
    of the image before are refused, used or not, when they come again under another stamp.
    """
    track = _after_order(track, image.time_ns)
    height, width = image.pixels.shape
    camera = track.geometry.camera
    attitude: dict[str, object] = {}
    remembered = track
    try:
        check_order(image, track.latest_ns)
        if (width, height) != (camera.width, camera.height):
            raise ImageRefused(
                'wrong_size',
                f'{width} x {height}, the camera has {camera.width} x {camera.height}',
            )
        sample = sample_rows(image.pixels)
        seen = fingerprint(image, sample)
        remembered = dataclasses.replace(track, seen=seen)
        quaternion, gap_s = attitudes.at(image.time_ns, setup.attitude.max_attitude_gap_s)
        attitude = {
            'icrf_from_star_tracker_xyzw': quaternion,
            'attitude_gap_s': gap_s,
            'catalog_digest': setup.catalog.digest,
        }
        saturation_dn = setup.centroid.saturation_dn
        screen(sample, seen, track.seen, saturation_dn, setup.dark, setup.screening)
        hot = (track.hot or setup.hot).index
        shot = Shot(_without_dark(image, setup), quaternion, gap_s, velocity_m_s, setup.site, hot)
        observations, after = _stars(shot, setup, remembered)
    except ImageRefused as refused:
        observations, after = (
            refused_image(
                image.time_ns, width, height, refused.reason, refused.detail, **attitude
            ),
            remembered,
        )
    return dataclasses.replace(observations, temperature_degc=temperature_degc), after


def _after_order(track: Track, time_ns: int) -> Track:
    """Where a sequence stands when an image has come; the third from the past starts it anew."""
    if track.latest_ns is None or time_ns > track.latest_ns:
        return dataclasses.replace(track, behind=0)
    behind = track.behind + 1 if track.behind and time_ns > track.behind_ns else 1
    if behind < _IMAGES_OF_A_RESTART:
        return dataclasses.replace(track, behind=behind, behind_ns=time_ns)
    return Track(track.geometry, hot=track.hot)


def _stars(shot: Shot, setup: Setup, track: Track) -> tuple[StarObservations, Track]:
    """The stars where the images before say, or else where a search of the image finds them."""
    time_ns = shot.image.time_ns
    if track.followed is not None:
        try:
            observations, followed = follow(
                shot, track.followed, setup.catalog, setup.centroid, setup.identification
            )
            # Good to a few pixels for the camera of the search, which searches over many.
            geometry = dataclasses.replace(
                track.geometry,
                star_tracker_from_camera_xyzw=followed.geometry.star_tracker_from_camera_xyzw,
            )
            after = dataclasses.replace(
                track, geometry=geometry, latest_ns=time_ns, followed=followed
            )
            return observations, _with_hot_pixels(after, shot, observations, setup)
        except ImageRefused:
            pass  # the search says what is wrong with the image
    observations, instrument = observe_stars(
        shot, track.geometry, setup.catalog, setup.centroid, setup.identification
    )
    if observations.refusal:
        return observations, track
    geometry = tracked(track.geometry, observations)
    after = dataclasses.replace(
        track,
        geometry=geometry,
        latest_ns=time_ns,
        followed=following(geometry, observations, instrument),
    )
    return observations, _with_hot_pixels(after, shot, observations, setup)


def _with_hot_pixels(
    track: Track, shot: Shot, observations: StarObservations, setup: Setup
) -> Track:
    """The track with the hot pixels that an image shows, which is aligned as the track says."""
    icrf_from_star_tracker = Rotation.from_quat(shot.icrf_from_star_tracker_xyzw)
    hot = learn_hot_pixels(
        track.hot or setup.hot,
        shot.image.pixels,
        observations.background_dn,
        observations.noise_dn,
        icrf_from_star_tracker * Rotation.from_quat(track.geometry.star_tracker_from_camera_xyzw),
        float(track.geometry.camera.parameters[0]),
        setup.fixed_pattern,
    )
    return dataclasses.replace(track, hot=hot)


def check_order(image: Image, latest_ns: int | None) -> None:
    """
    Hold the stamp of an image against that of the last one used, None where there is none.

    Raises
    ------
    ImageRefused
        ``out_of_order``.
    """
    if latest_ns is not None and image.time_ns <= latest_ns:
        late_s = (latest_ns - image.time_ns) * 1e-9
        raise ImageRefused('out_of_order', f'{late_s:.6f} s before the last image used')


def latest_at(samples: Sequence[tuple[int, T]], time_ns: int, without: T) -> T:
    """
    The last sample at or before a time, else the first after it; ``without`` where there is none.

    A spacecraft's velocity changes by under 10 m/s (0.007 arcsec) between the samples of a minute,
    and a camera's temperature by less than its sensor tells.
    """
    before = [sample for stamp_ns, sample in samples if stamp_ns <= time_ns]
    if before:
        return before[-1]
    return samples[0][1] if samples else without


def observe_bag(
    paths: Sequence[Path],
    image_topic: str,
    attitude_topic: str,
    setup: Setup,
    velocity_topic: str = '',
    temperature_topic: str = '',
    on_image: OnImage | None = None,
) -> Iterator[StarObservations]:
    """
    Observations of every image of a bag, in the order of the bag; one image in memory at a time.

    ``on_image`` is shown each image that could be decoded, with its observations and what the
    stars were predicted with.

    Raises
    ------
    BagError
        When the bag cannot be read or a topic is not in it.
    """
    attitudes = bag.read_attitudes(paths, attitude_topic, setup.attitude)
    velocities = (
        sorted(bag.read_velocities(paths, velocity_topic), key=lambda sample: sample[0])
        if velocity_topic
        else []
    )
    temperatures = (
        sorted(bag.read_temperatures(paths, temperature_topic), key=lambda sample: sample[0])
        if temperature_topic
        else []
    )
    track = Track(setup.prior)
    for image in bag.read_images(paths, image_topic, setup.attitude.stamp_offset_s):
        if isinstance(image, StarObservations):
            yield image
            continue
        predicted_with = track.geometry
        observations, track = observe_next(
            image,
            attitudes,
            setup,
            track,
            latest_at(velocities, image.time_ns, None),
            latest_at(temperatures, image.time_ns, math.nan),
        )
        if on_image is not None:
            on_image(image, observations, predicted_with)
        yield observations


def add_to_ensemble(ensemble: Ensemble, observations: StarObservations, setup: Setup) -> Ensemble:
    """
    Return the ensemble with one more image; at ``max_images`` the least informative goes.

    An image of another size than the prior camera's is counted as refused: its stars are of
    another camera.
    """
    size, camera = (observations.width, observations.height), setup.prior.camera
    if not observations.refusal and size != (camera.width, camera.height):
        observations = dataclasses.replace(observations, refusal='wrong_size')
    return within_limit(ensemble.add(observations), setup)


def within_limit(ensemble: Ensemble, setup: Setup) -> Ensemble:
    """Return the ensemble without its least informative images, down to ``max_images``."""
    return keep_most_informative(ensemble, setup.prior, setup.calibration)


def ensemble_status(ensemble: Ensemble, setup: Setup) -> EnsembleStatus:
    """What has been collected and what a calibration from it would be worth."""
    return _ensemble_status(ensemble, setup.prior, setup.calibration)


def solve(
    ensemble: Ensemble,
    setup: Setup,
    method: str = '',
    estimate: Sequence[str] = (),
    inputs: Mapping[str, str] | None = None,
    in_force: Calibration | None = None,
) -> Calibration:
    """
    A calibration of the ensemble with the verdict of the gate and its provenance.

    ``method`` and ``estimate`` override the options where not empty; ``inputs`` names what the
    observations came from, for the provenance; the gate holds the change against ``in_force``.

    Raises
    ------
    TooFewObservations
        When the ensemble cannot carry it; the text says what is missing.
    OptionError
        For a method or parameter name that is none.
    """
    return solve_with_residuals(ensemble, setup, method, estimate, inputs, in_force)[0]


def solve_with_residuals(
    ensemble: Ensemble,
    setup: Setup,
    method: str = '',
    estimate: Sequence[str] = (),
    inputs: Mapping[str, str] | None = None,
    in_force: Calibration | None = None,
) -> tuple[Calibration, Residuals]:
    """The calibration of `solve`, and what it left over of every star and image."""
    override: dict[str, object] = {}
    if method:
        override['method'] = method
    if estimate:
        override['estimate'] = tuple(estimate)
    for field in dataclasses.fields(CalibrationOptions):
        if field.name in override:
            check_value(field, override[field.name])
    options = dataclasses.replace(setup.calibration, **override)  # type: ignore[arg-type]
    setup = dataclasses.replace(setup, calibration=options)
    result = estimate_calibration(ensemble, setup.prior, options)
    calibration = _calibration(result, ensemble, setup, inputs or {}, in_force)
    colour_bp_rp = setup.catalog.colours_bp_rp(result.table.catalog_id)
    return calibration, residuals_of(result, ensemble, colour_bp_rp)


def _calibration(
    result: Estimate,
    ensemble: Ensemble,
    setup: Setup,
    inputs: Mapping[str, str],
    in_force: Calibration | None,
) -> Calibration:
    """Statistics, verdict and provenance of an estimate."""
    options = setup.calibration
    kept = result.kept
    rms_px = float(np.sqrt(np.mean(result.residual_px[kept] ** 2)))
    camera = result.geometry.camera
    singular_values, weakest = weakest_direction(result.information, result.information_names)
    zero_skew_cost_px = zero_skew_fit(camera)[1]
    maps = detector_maps(camera, result.covariance, result.table.measured_px[kept])
    agreed: Difference | str = 'min_halves_chance is 0'
    if setup.gate.min_halves_chance > 0:
        agreed = halves(ensemble, setup.prior, options)
    step = None
    if in_force is not None:
        step = difference(
            in_force.geometry,
            in_force.covariance,
            result.geometry,
            result.covariance,
            tuple(name for name in options.estimate if name in in_force.estimated),
        )
    given_rad = np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD
    checks = judge(
        Candidate(
            geometry=result.geometry,
            prior=setup.prior,
            covariance=result.covariance,
            residual_rms_px=rms_px,
            images_used=len(ensemble.images),
            images_misfit=int(result.misfit_image.sum()),
            stars_used=int(kept.sum()),
            stars_rejected=int((~kept).sum()),
            coverage=maps.stars,
            map_sigma_px=float(map_sigma_px(camera, result.covariance).max()),
            line_of_sight_sigma_arcsec=float(maps.line_of_sight_sigma_arcsec.max()),
            singular_value=float(singular_values[-1]),
            zero_skew_cost_px=zero_skew_cost_px,
            star_tracker_excess=float((result.star_tracker_sigma_rad / given_rad).max()),
            termination=result.termination,
            halves=agreed,
            step=step,
        ),
        setup.gate,
        options,
    )
    reasons = reasons_of(checks)
    return Calibration(
        time_ns=max(image.time_ns for image in ensemble.images),
        geometry=result.geometry,
        covariance=result.covariance,
        method=options.method,
        estimated=options.estimate,
        residual_rms_px=rms_px,
        variance_factor=result.variance_factor,
        images_used=len(ensemble.images),
        images_refused=dict(ensemble.refused),
        stars_used=int(kept.sum()),
        stars_rejected=int((~kept).sum()),
        alignment_scatter_arcsec=result.alignment_scatter_arcsec,
        star_tracker_sigma_arcsec=tuple(
            float(sigma) for sigma in result.star_tracker_sigma_rad / ARCSECOND_RAD
        ),
        centroid_scale=result.variance.scale,
        centroid_floor_px=math.sqrt(result.variance.floor_px2),
        dropped_catalog_ids=tuple(result.dropped_catalog_id.tolist()),
        misfit_images_ns=tuple(
            image.time_ns
            for image, misfit in zip(ensemble.images, result.misfit_image, strict=True)
            if misfit
        ),
        singular_values=tuple(float(value) for value in singular_values),
        weakest_direction=weakest,
        zero_skew_cost_px=zero_skew_cost_px,
        iterations=result.iterations,
        termination=result.termination,
        accepted=not reasons,
        reasons=reasons,
        parent_frame=setup.frames.star_tracker_frame,
        child_frame=setup.frames.camera_frame,
        provenance=_provenance(setup, ensemble, inputs),
        thermal=result.thermal,
        maps=maps,
        correlation=correlation(result.shared_covariance, result.shared_names),
        removals=removal_study(result),
        first_image_ns=min(image.time_ns for image in ensemble.images),
        halves=None
        if isinstance(agreed, str)
        else Halves(
            shape_px=agreed.shape_px,
            shape_chance=agreed.shape_chance,
            turn_arcsec=agreed.turn_rad / ARCSECOND_RAD,
            chance=agreed.chance,
        ),
        gate=checks,
    )


def _provenance(setup: Setup, ensemble: Ensemble, inputs: Mapping[str, str]) -> dict[str, str]:
    """Where a calibration comes from, enough to repeat it."""
    prior = np.r_[setup.prior.camera.parameters, setup.prior.star_tracker_from_camera_xyzw]
    digest = hashlib.sha256()
    for image in ensemble.images:
        for column in (image.catalog_id, image.measured_px, image.covariance_px2):
            digest.update(np.ascontiguousarray(column).tobytes())
        if not math.isnan(image.temperature_degc):
            digest.update(np.float64(image.temperature_degc).tobytes())
    return {
        'software': f'starcal {software_version()}',
        'catalog': setup.catalog.digest,
        'options': json.dumps(setup.options(), sort_keys=True),
        'prior': json.dumps(prior.tolist()),
        'observations_sha256': digest.hexdigest(),
        **{f'input {name}': value for name, value in inputs.items()},
    }


def software_version() -> str:
    """Version of the installed package; 'unknown' where it runs from a bare source tree."""
    try:
        return importlib.metadata.version('starcal_ros')
    except importlib.metadata.PackageNotFoundError:
        return 'unknown'
