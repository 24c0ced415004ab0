# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A bag of images and telemetry of a mission, and a parameter file to calibrate it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import heapq
from itertools import repeat
import json
import math
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any

import numpy as np

from starcal_ground import products, written_files
from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags.reader import IMAGE_FILE
from starcal_ground.images import image_series
from starcal_ground.images.photographs import Refusals
from starcal_ground.mission.ingest.mission_records import Attitudes, Guard, Velocities
from starcal_ground.products import input_name
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.errors import IngestError
from starcal_ros.formats.products import product_files
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.records import Image, ORIGINAL, PIXELS_OF
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
    """
    The camera file and alignments of a calibration of the bag.

    ``alignments_xyzw`` has four numbers for the first star tracker, then for each further one.
    """

    camera: Path
    alignments_xyzw: tuple[float, ...]


def frame_name(frame: str) -> str:
    """Name of a star tracker frame in topics and parameters, from that in a file."""
    name = re.sub(r'\W+', '_', frame)
    return name if name[:1].isalpha() else f'star_tracker_{name.strip("_")}'


@dataclass(frozen=True)
class Recorded:
    """Paths of a bag that was written, and notes: one line for each thing to know of it."""

    bag: Path
    params: Path | None
    notes: tuple[str, ...]


def look_at_all(
    paths: Sequence[Path],
    options: image_series.ImageOptions,
    guard: Guard,
    on_image: Callable[[], None] = lambda: None,
) -> list[image_series.ImageFile]:
    """
    The image files in order of time.

    Raises IngestError with the files that cannot be used, by their reasons, or when the images
    have different sizes, or two have one time.
    """
    files, refusals = [], Refusals('cannot be used')
    for path in paths:
        with refusals.of(path):
            files.append(guard.call(path, image_series.look, path, _options_of(path, options)))
        on_image()
    if lines := refusals.lines():
        raise IngestError('; '.join(lines))
    image_series.check_alike(files)
    return sorted(files, key=lambda file: file.time_ns)


def _options_of(path: Path, options: image_series.ImageOptions) -> image_series.ImageOptions:
    """Options without the times of the other images, which are not sent with each."""
    if options.times is None:
        return options
    times = {name: options.times[name] for name in (path.name,) if name in options.times}
    return replace(options, times=times)


def check_place(bag: Path, inputs: Sequence[Path], camera: Path | None = None) -> None:
    """
    `check_outputs` of a bag and the files beside it, which an import made; a prior camera stays.

    Raises ProductError naming the file.
    """
    record, params, copied = _files_beside(bag)
    prior = [params] if camera else []
    if camera and not products.same_as_one_of(copied, [camera]):
        prior.append(copied)
    writer = BagWriter(bag)
    products.check_outputs((*writer.outputs(), record, *prior), inputs)
    products.check_maker(writer.file, record)


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
    files: Sequence[image_series.ImageFile],
    options: image_series.ImageOptions,
    guard: Guard,
    attitudes: Attitudes,
    velocities: Velocities | None = None,
    prior: Prior | None = None,
    on_image: Callable[[], None] = lambda: None,
    others: Mapping[str, Attitudes] = MappingProxyType({}),
    originals: Mapping[str, str] = MappingProxyType({}),
) -> Recorded:
    """
    Write a bag in order of time, ``import.json`` and, with a prior, ``params.yaml`` beside it.

    ``others`` are the attitudes of further star trackers by `frame_name`, ``originals`` the
    SHA-256 of all files by their names, which the bag carries to the provenance of a calibration.

    Raises IngestError when no image has attitudes about it. Raises BagError or ProductError when a
    file cannot be written or the prior camera cannot be read.
    """
    covered = [_gap_s(attitudes, file.time_ns) for file in files]
    notes = [*attitudes.notes, *(velocities.notes if velocities else ())]
    notes += _coverage_notes(files, attitudes, covered)
    scale = image_series.common_scale(files, options)
    notes += _scale_notes(files, scale)
    pixels_of = list(dict.fromkeys(file.pixels_of for file in files if file.pixels_of))
    notes += [f'pixels of the images: {words}' for words in pixels_of]
    origin = {PIXELS_OF: '; '.join(pixels_of)} if pixels_of else {}
    origin |= {f'{ORIGINAL}{k}': v for k, v in originals.items()}
    origin |= {f'{IMAGE_FILE}{file.time_ns}': input_name(file.path) for file in files}
    writer = BagWriter(bag, origin)
    record, params, copied = _files_beside(bag)
    content = {
        'bag': writer.file.name,
        'images': [file.path.name for file in files],
        'scale': {'offset': scale.offset, 'step': scale.step, 'dtype': scale.dtype.__name__},
        'channel': options.channel,
        'bayer': options.bayer,
        'notes': list(dict.fromkeys(notes)),
    }
    prior_files = {}
    if prior is not None:
        prior_files = _prior_files(prior, params, copied, files, scale, tuple(others))
    with writer:
        trackers = {ATTITUDE_TOPIC: attitudes}
        trackers |= {f'/{frame}/attitude': other for frame, other in others.items()}
        _write_messages(writer, files, options, scale, guard, trackers, velocities, on_image)
        # Just before the bag replaces an older one; the record first, which marks it as ours.
        written_files.write_marked(record, json.dumps(content, indent=1) + '\n')
        for path, text in prior_files.items():
            written_files.write_marked(path, text)
    return Recorded(bag, params if prior else None, tuple(dict.fromkeys(notes)))


def _near(attitudes: Attitudes, files: Sequence[image_series.ImageFile]) -> Attitudes:
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
    files: Sequence[image_series.ImageFile], attitudes: Attitudes, gaps_s: Sequence[float]
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


def _scale_notes(
    files: Sequence[image_series.ImageFile], scale: image_series.PixelScale
) -> list[str]:
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


def _write_messages(
    writer: BagWriter,
    files: Sequence[image_series.ImageFile],
    options: image_series.ImageOptions,
    scale: image_series.PixelScale,
    guard: Guard,
    trackers: Mapping[str, Attitudes],
    velocities: Velocities | None,
    on_image: Callable[[], None],
) -> None:
    """Write images and telemetry in order of time; at one stamp the attitude is first."""
    messages: list[Iterable[tuple[int, int, Any]]] = [((file.time_ns, 2, file) for file in files)]
    for topic, attitudes in trackers.items():
        near = _near(attitudes, files)
        to_topic = zip(repeat(topic), near.icrf_from_star_tracker_xyzw)
        messages.append(zip(near.time_ns.tolist(), repeat(0), to_topic))
    if velocities is not None:
        stamps = velocities.time_ns.tolist()
        messages.append(zip(stamps, repeat(1), velocities.velocity_m_s))
    for time_ns, rank, content in heapq.merge(*messages, key=lambda message: message[:2]):
        if rank == 0:
            topic, xyzw = content
            writer.write_attitude(topic, time_ns, xyzw, 'icrf')
        elif rank == 2:
            if not math.isnan(content.temperature_degc):
                writer.write_temperature(
                    TEMPERATURE_TOPIC, time_ns, content.temperature_degc, 'camera'
                )
            wanted = _options_of(content.path, options)
            pixels = guard.call(content.path, image_series.pixels_of, content.path, wanted, scale)
            writer.write_image(IMAGE_TOPIC, Image(time_ns, pixels), 'camera')
            on_image()
        else:
            writer.write_velocity(VELOCITY_TOPIC, time_ns, content, 'icrf')


def _prior_files(
    prior: Prior,
    params: Path,
    copied: Path,
    files: Sequence[image_series.ImageFile],
    scale: image_series.PixelScale,
    others: Sequence[str],
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
        'prior_alignment': list(prior.alignments_xyzw[:4]),
        'star_tracker_frame': 'star_tracker',
        'camera_frame': 'camera',
    }
    if others:
        values['more_star_trackers'] = list(others)
        values['more_alignments'] = list(prior.alignments_xyzw[4:])
    saturation = [file.saturation for file in files if not math.isnan(file.saturation)]
    if saturation:
        values['saturation_dn'] = (min(saturation) - scale.offset) / scale.step
    content = {'/**': {'ros__parameters': values}}
    texts = {params: products.yaml_text(content)}
    if not products.same_as_one_of(copied, [prior.camera]):
        texts[copied] = product_files.read_text(prior.camera, PARAMETER_BYTES)
    return texts
