# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A bag of images and telemetry of a mission, and a parameter file to calibrate it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import dataclasses
from dataclasses import dataclass, field
import heapq
import json
import math
from pathlib import Path

import numpy as np
import yaml

from starcal_ros.arrays import Floats
from starcal_ros.bag.places import check_replaceable
from starcal_ros.bag.writer import BagWriter
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.files import same_as_one_of
from starcal_ros.ingest.guard import Guard
from starcal_ros.ingest.images import (
    check_alike,
    common_scale,
    ImageFile,
    ImageOptions,
    look,
    pixels_of,
    Scale,
)
from starcal_ros.ingest.records import Attitudes, IngestError, Velocities
from starcal_ros.products.camera_yaml import read_camera_info
from starcal_ros.products.files import check_not_inputs, read_text, write_atomically
from starcal_ros.records import Image
from starcal_ros.sky.attitude import AttitudeOptions
from starcal_ros.untrusted import PARAMETER_BYTES

IMAGE_TOPIC = '/camera/image_raw'
ATTITUDE_TOPIC = '/star_tracker/attitude'
VELOCITY_TOPIC = '/spacecraft/velocity'
TEMPERATURE_TOPIC = '/camera/temperature'
_MARGIN_NS = 60 * NANOSECONDS_PER_SECOND  # for an offset of the stamps of the camera
_COARSE = 1 / 3  # step of the pixel values over their noise from which centroids lose accuracy


@dataclass(frozen=True)
class Prior:
    """The camera file and alignment of a calibration of the bag."""

    camera: Path
    star_tracker_from_camera_xyzw: tuple[float, ...]


@dataclass(frozen=True)
class Recorded:
    """Paths of a bag that was written, and notes: one line for each thing to know of it."""

    bag: Path
    params: Path | None
    notes: tuple[str, ...] = field(default=())


def look_at_all(
    paths: Sequence[Path],
    options: ImageOptions,
    guard: Guard,
    on_image: Callable[[], None] = lambda: None,
) -> tuple[list[ImageFile], list[str]]:
    """
    The image files in order of time, and one line for each file that cannot be taken.

    Raises
    ------
    IngestError
        When the images have different sizes, or two have one time.
    """
    files, problems = [], []
    for path in paths:
        try:
            files.append(guard.call(path, look, path, _options_of(path, options)))
        except IngestError as error:
            problems.append(str(error))
        on_image()
    if files:
        check_alike(files)
    return sorted(files, key=lambda file: file.time_ns), problems


def _options_of(path: Path, options: ImageOptions) -> ImageOptions:
    """Options without the times of the other images, which are not sent with each."""
    if options.times is None:
        return options
    times = {name: options.times[name] for name in (path.name,) if name in options.times}
    return dataclasses.replace(options, times=times)


def check_place(bag: Path, inputs: Sequence[Path], camera: Path | None = None) -> None:
    """
    Check that a bag and the files beside it replace no input and no file of another origin.

    Raises
    ------
    BagError, ProductError
        Naming the file.
    """
    record, params, copied = _files_beside(bag)
    check_not_inputs([BagWriter(bag).file, record, params], inputs)
    others = [params, copied] if camera else []
    others = [path for path in others if not same_as_one_of(path, filter(None, [camera]))]
    check_replaceable(bag, record, others, 'scale', 'an imported bag')


def _files_beside(bag: Path) -> tuple[Path, Path, Path]:
    """Paths of the record, the parameter file and the camera file of a bag."""
    start = f'{bag.stem}_' if bag.suffix == '.mcap' else ''
    record, params, camera = (
        BagWriter(bag).file.with_name(f'{start}{name}')
        for name in ('import.json', 'params.yaml', 'camera.yaml')
    )
    return record, params, camera


def write_bag(
    bag: Path,
    files: Sequence[ImageFile],
    options: ImageOptions,
    guard: Guard,
    attitudes: Attitudes,
    velocities: Velocities | None = None,
    prior: Prior | None = None,
    on_image: Callable[[], None] = lambda: None,
) -> Recorded:
    """
    Write a bag in order of time, ``import.json`` and, with a prior, ``params.yaml`` beside it.

    Raises
    ------
    IngestError
        When no image has attitudes about it.
    BagError, ProductError
        When a file cannot be written or the prior camera cannot be read.
    """
    covered = [_gap_s(attitudes, file.time_ns) for file in files]
    notes = [*attitudes.notes, *(velocities.notes if velocities else ())]
    notes += _coverage_notes(files, attitudes, covered)
    scale = common_scale(files, options)
    notes += _scale_notes(files, scale)
    writer = BagWriter(bag)
    record, params, copied = _files_beside(bag)
    content = {
        'bag': writer.file.name,
        'images': [file.path.name for file in files],
        'scale': {'offset': scale.offset, 'step': scale.step, 'dtype': scale.dtype.__name__},
        'channel': options.channel,
        'bayer': options.bayer,
        'notes': list(dict.fromkeys(notes)),
    }
    prior_files = {} if prior is None else _prior_files(prior, params, copied, files, scale)
    with writer:
        for _, _, write in heapq.merge(
            _image_messages(files, options, scale, guard, on_image),
            _attitude_messages(_near(attitudes, files)),
            _velocity_messages(velocities),
            key=lambda message: message[:2],
        ):
            write(writer)
        # Just before the bag replaces an older one; the record first, which marks it as ours.
        write_atomically(record, json.dumps(content, indent=1) + '\n')
        for path, text in prior_files.items():
            write_atomically(path, text)
    return Recorded(bag, params if prior else None, tuple(dict.fromkeys(notes)))


def _near(attitudes: Attitudes, files: Sequence[ImageFile]) -> Attitudes:
    """Attitudes from a minute before the first image to a minute after the last."""
    stamps = attitudes.time_ns
    first_ns, last_ns = files[0].time_ns - _MARGIN_NS, files[-1].time_ns + _MARGIN_NS
    keep = (stamps >= first_ns) & (stamps <= last_ns)
    return Attitudes(stamps[keep], attitudes.icrf_from_star_tracker_xyzw[keep])


def _gap_s(attitudes: Attitudes, time_ns: int) -> float:
    """Time between the attitudes before and after a stamp; infinite where one is missing."""
    stamps = attitudes.time_ns
    k = int(np.searchsorted(stamps, time_ns))
    if k < len(stamps) and stamps[k] == time_ns:
        return 0.0
    if k in (0, len(stamps)):
        return math.inf
    return float(stamps[k] - stamps[k - 1]) / NANOSECONDS_PER_SECOND


def _span(first_ns: int, last_ns: int) -> str:
    return f'{utc_text(first_ns)} to {utc_text(last_ns)}'


def _coverage_notes(
    files: Sequence[ImageFile], attitudes: Attitudes, gaps_s: Sequence[float]
) -> list[str]:
    longest_s = AttitudeOptions().max_attitude_gap_s
    outside = [file for file, gap_s in zip(files, gaps_s, strict=True) if math.isinf(gap_s)]
    if len(outside) == len(files):
        raise IngestError(
            f'no attitude before and after any image: the images are from '
            f'{_span(files[0].time_ns, files[-1].time_ns)}, the attitudes of another time, from '
            f'{_span(*attitudes.time_ns[[0, -1]].tolist())}'
        )
    notes = []
    if outside:
        notes.append(
            f'{len(outside)} of {len(files)} images have no attitude about them, the first is '
            f'{outside[0].path.name} at {utc_text(outside[0].time_ns)}'
        )
    wide = [gap_s for gap_s in gaps_s if longest_s < gap_s < math.inf]
    if wide:
        notes.append(
            f'{len(wide)} of {len(files)} images are in gaps of up to {max(wide):.3g} s between '
            f'attitudes: refused, unless max_attitude_gap_s is over {longest_s:g}'
        )
    return notes


def _scale_notes(files: Sequence[ImageFile], scale: Scale) -> list[str]:
    if scale.is_none:
        return []
    notes = [f'pixel values are {scale.offset:.9g} + {scale.step:.9g} DN']
    noise = float(np.median([file.noise for file in files]))
    if noise > 0 and scale.step > _COARSE * noise:
        notes.append(
            f'a step of 16 bit is {scale.step / noise:.2g} of the noise: give --value-range with '
            'the range of the stars'
        )
    return notes


_Message = tuple[int, int, Callable[[BagWriter], None]]


def _image_messages(
    files: Sequence[ImageFile],
    options: ImageOptions,
    scale: Scale,
    guard: Guard,
    on_image: Callable[[], None],
) -> Iterator[_Message]:
    for file in files:

        def write(writer: BagWriter, file: ImageFile = file) -> None:
            if not math.isnan(file.temperature_degc):
                writer.write_temperature(
                    TEMPERATURE_TOPIC, file.time_ns, file.temperature_degc, 'camera'
                )
            path = file.path
            pixels = guard.call(path, pixels_of, path, _options_of(path, options), scale)
            image = Image(file.time_ns, pixels)
            writer.write_image(IMAGE_TOPIC, image, 'camera')
            on_image()

        yield file.time_ns, 2, write


def _attitude_messages(attitudes: Attitudes) -> Iterator[_Message]:
    for time_ns, xyzw in zip(
        attitudes.time_ns.tolist(), attitudes.icrf_from_star_tracker_xyzw, strict=True
    ):

        def write(writer: BagWriter, time_ns: int = time_ns, xyzw: Floats = xyzw) -> None:
            writer.write_attitude(ATTITUDE_TOPIC, time_ns, xyzw, 'icrf')

        yield time_ns, 0, write


def _velocity_messages(velocities: Velocities | None) -> Iterator[_Message]:
    if velocities is None:
        return
    for time_ns, velocity in zip(
        velocities.time_ns.tolist(), velocities.velocity_m_s, strict=True
    ):

        def write(writer: BagWriter, time_ns: int = time_ns, velocity: Floats = velocity) -> None:
            writer.write_velocity(VELOCITY_TOPIC, time_ns, velocity, 'icrf')

        yield time_ns, 1, write


def _prior_files(
    prior: Prior, params: Path, copied: Path, files: Sequence[ImageFile], scale: Scale
) -> dict[Path, str]:
    """Texts of the parameter file and of the copy of the prior camera."""
    camera = read_camera_info(prior.camera)
    if (camera.width, camera.height) != (files[0].width, files[0].height):
        raise IngestError(
            f'{prior.camera}: a camera of {camera.width} x {camera.height}, the images have '
            f'{files[0].width} x {files[0].height}'
        )
    values: dict[str, object] = {
        'camera_info_url': copied.name,
        'prior_alignment': list(prior.star_tracker_from_camera_xyzw),
        'star_tracker_frame': 'star_tracker',
        'camera_frame': 'camera',
    }
    saturation = [file.saturation for file in files if not math.isnan(file.saturation)]
    if saturation:
        values['saturation_dn'] = (min(saturation) - scale.offset) / scale.step
    content = {'/**': {'ros__parameters': values}}
    texts = {params: yaml.safe_dump(content, sort_keys=False, default_flow_style=None)}
    if not same_as_one_of(copied, [prior.camera]):
        texts[copied] = read_text(prior.camera, PARAMETER_BYTES)
    return texts
