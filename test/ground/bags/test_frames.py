# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images with the telemetry of their time, from one pass over a bag in any order."""

from pathlib import Path
import sys
import threading
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from starcal_tool import run_python  # type: ignore[import-not-found]

from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import frames as frames_module
from starcal_ground.bags import reader
from starcal_ground.bags.frames import Frame, read_frames, read_telemetry, Telemetry
from starcal_ground.bags.reader import read_images, Topics
from starcal_ros.arrays import Floats
from starcal_ros.formats.bag import typestore
from starcal_ros.records import Image
from starcal_ros.sky.attitude import AttitudeOptions

TOPICS = Topics('/image', '/attitude', '/velocity', '/temperature')
OPTIONS = AttitudeOptions()
START_NS = 1_700_000_000_000_000_000
TENTH_NS = 100_000_000
IMAGES = 9

Recorded = tuple[str, int]  # kind and stamp in tenths of a second


def recording() -> list[Recorded]:
    """Images every second between attitudes at 5 Hz; one velocity and temperature in between."""
    made: list[Recorded] = [('attitude', k) for k in range(-1, 10 * IMAGES + 15, 2)]
    made += [('image', 10 * k) for k in range(IMAGES)]
    made += [(kind, k) for kind in ('velocity', 'temperature') for k in (-4, 33, 61)]
    return sorted(made, key=lambda item: item[1])


def write(path: Path, messages: list[Recorded], size: int = 4) -> Path:
    random = np.random.default_rng(3)
    with BagWriter(path) as writer:
        for kind, tenths in messages:
            time_ns = START_NS + tenths * TENTH_NS
            if kind == 'image':
                pixels = random.integers(0, 4096, (size, size)).astype(np.uint16)
                writer.write_image('/image', Image(time_ns, pixels), 'camera')
            elif kind == 'attitude':
                half_rad = 1e-3 * tenths**1.1 if tenths > 0 else 0.0
                xyzw = np.array([0.0, np.sin(half_rad), 0.0, np.cos(half_rad)])
                writer.write_attitude('/attitude', time_ns, xyzw, 'icrf')
            elif kind == 'velocity':
                writer.write_velocity('/velocity', time_ns, np.array([tenths, 2.0, 3e4]), 'icrf')
            else:
                writer.write_temperature('/temperature', time_ns, 0.5 * tenths, 'camera')
    return path


def numbers_of(frame: Frame) -> Floats:
    """Attitude (4), gap, velocity (3) and temperature of a frame when it is yielded."""
    seen = Telemetry(TOPICS, OPTIONS)
    seen.attitudes = frame.attitudes
    numbers = seen.numbers_at(frame.image.time_ns)
    velocity_m_s = frame.velocity_m_s
    numbers[10:13] = np.nan if velocity_m_s is None else velocity_m_s
    numbers[13] = frame.temperature_degc
    return numbers


def compared(paths: list[Path]) -> tuple[int, int, list[str]]:
    """Frames, frames with other telemetry than that of a full read, and reports."""
    said: list[str] = []
    full = read_telemetry(paths, TOPICS, OPTIONS)
    count = differ = 0
    for frame in read_frames(paths, TOPICS, OPTIONS, said.append):
        assert isinstance(frame, Frame)
        expected = full.numbers_at(frame.image.time_ns)
        differ += not np.array_equal(numbers_of(frame), expected, equal_nan=True)
        count += 1
    return count, differ, said


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(typestore, '_CHUNK_BYTES', 600)


def test_attitudes_in_a_file_of_their_own_are_found(tmp_path, monkeypatch) -> None:
    """Few images wait: the fourth starts a pass over the telemetry."""
    monkeypatch.setattr(frames_module, '_WAITING_BYTES', 100)
    images = [item for item in recording() if item[0] == 'image']
    others = [item for item in recording() if item[0] != 'image']
    paths = [write(tmp_path / 'images', images), write(tmp_path / 'others', others)]
    assert compared(paths) == (IMAGES, 0, [])


@pytest.mark.parametrize(('hole', 'beside'), [((22, 48), 1), ((-10, 12), 0), ((75, 120), 0)])
def test_a_gap_filled_at_the_end_of_the_recording(tmp_path, hole, beside) -> None:
    """Samples of over 2 s come last; the image just before them has a rate of fewer: reported."""
    low, high = hole
    late = [item for item in recording() if item[0] == 'attitude' and low < item[1] < high]
    rest = [item for item in recording() if item not in late]
    count, differ, said = compared([write(tmp_path / 'bag', rest + late)])
    assert (count, differ, len(said)) == (IMAGES, beside, beside)


@pytest.mark.slow
@settings(max_examples=60)
@given(data=st.data())
def test_no_order_of_recording_changes_a_frame_unreported(tmp_path_factory, data) -> None:
    """Messages that are delayed by under a second change nothing; others are counted."""
    most_tenths = data.draw(st.sampled_from([9, 40, 200]))
    messages = recording()
    delays = data.draw(
        st.lists(st.integers(0, most_tenths), min_size=len(messages), max_size=len(messages))
    )
    order = sorted(range(len(messages)), key=lambda k: messages[k][1] + delays[k])
    bag = write(tmp_path_factory.mktemp('order') / 'bag', [messages[k] for k in order])
    count, differ, said = compared([bag])
    assert count == IMAGES
    assert len(said) == (differ > 0)
    assert not said or f'; {differ} images' in said[0]
    if most_tenths == 9:
        assert differ == 0


@pytest.mark.parametrize('order', ['last', 'first', 'alone'])
def test_bad_velocities_are_left_out_and_reported_once(tmp_path, order) -> None:
    """A velocity that is no number ended in a traceback of the images."""
    with BagWriter(tmp_path / 'bag') as writer:
        for second in range(10):
            bad = order == 'alone' or (second > 4) == (order == 'last')
            speeds = np.array([0.0, np.nan if bad else 7.0, 0.0])
            writer.write_velocity('/velocity', second * 10**9, speeds, 'icrf')
    told: list[str] = []
    read = read_telemetry([tmp_path / 'bag'], TOPICS, on_damage=told.append)
    assert len(read.velocities) + read.velocities_left_out == 10
    assert read.velocities_left_out == (10 if order == 'alone' else 5)
    assert len(told) == 1 and told[0].startswith('/velocity: velocity [0.0, ')
    velocity_m_s, _ = read.at(7 * 10**9)
    if order == 'alone':
        assert velocity_m_s is None
    else:
        assert velocity_m_s is not None and velocity_m_s[1] == 7.0


def test_a_damaged_chunk_costs_what_is_in_it(tmp_path, small_chunks) -> None:
    """The frames of a damaged bag are its images, and the loss is reported as by `read_images`."""
    bag = write(tmp_path / 'bag', recording())
    (file,) = bag.glob('*.mcap')
    whole = bytearray(file.read_bytes())
    whole[len(whole) // 3] ^= 4
    file.write_bytes(whole)
    of_images: list[str] = []
    images = list(read_images([bag], '/image', on_damage=of_images.append))
    _, _, said = compared([bag])
    frames = list(read_frames([bag], TOPICS, OPTIONS, said.append))
    assert [frame.image.time_ns for frame in frames if isinstance(frame, Frame)] == [
        image.time_ns for image in images if isinstance(image, Image)
    ]
    assert of_images and set(of_images) <= set(said)


def test_the_reading_thread_ends_with_its_reader(tmp_path) -> None:
    frames = read_frames([write(tmp_path / 'bag', recording(), size=64)], TOPICS, OPTIONS)
    next(frames)
    assert any(thread.name.startswith('read-ahead') for thread in threading.enumerate())
    frames.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith('read-ahead') for thread in threading.enumerate())


# Whether all that may be read ahead is in memory already after fifteen images, or later, depends
# on the threads.
MEMORY = """
import resource, sys
from starcal_ground.bags import frames
from starcal_ground.bags.reader import Topics
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for k, frame in enumerate(frames.read_frames([sys.argv[1]], Topics('/image', '/attitude'))):
    if k == 15:
        early = peak()
print(k, peak() - early)
"""


@pytest.mark.skipif(sys.platform != 'linux', reason='ru_maxrss is in kB on Linux')
@pytest.mark.slow
def test_memory_is_flat(tmp_path) -> None:
    """Fifty images need no more memory than fifteen, with an attitude after each only."""
    messages = [item for k in range(50) for item in (('attitude', 20 * k - 1), ('image', 20 * k))]
    path = write(tmp_path / 'long', [*messages, ('attitude', 1001)], size=1000)
    last, growth_kb = map(int, run_python('-c', MEMORY, path).stdout.split())
    assert last == 49
    assert growth_kb < 32_000  # two batches of 8 MB and the heap; the images between are 68 MB


ORDERS = {
    'in order': lambda raws: raws,
    'reversed': lambda raws: raws[::-1],
    'shuffled': lambda raws: [raws[k] for k in np.random.default_rng(4).permutation(len(raws))],
    'by topic': lambda raws: sorted(raws, key=lambda raw: (raw.topic != '/image', raw.topic)),
    'two swapped': lambda raws: [*raws[:30], raws[60], *raws[30:60], *raws[61:]],
}


def rewritten(source: Path, path: Path, order: str, outside: str, is_logged_anew: bool) -> Path:
    """A bag of the messages of another in an order, those of one topic outside of chunks."""
    raws = list(reader.read_raw([source]))
    with path.open('wb') as stream:
        writer: Any = typestore.started(stream)
        chunk, channels = writer._Writer__chunk_builder, {}
        for k, raw in enumerate(ORDERS[order](raws)):
            writer._Writer__chunk_builder = None if raw.topic in outside.split() else chunk
            if raw.topic not in channels:
                channels[raw.topic] = typestore.opened(writer, raw.topic, raw.type_name)
            time_ns = START_NS + k if is_logged_anew else raw.log_time_ns
            writer.add_message(channels[raw.topic], time_ns, raw.data, time_ns)
        writer._Writer__chunk_builder = chunk
        writer.finish()
    return path


@pytest.mark.parametrize(('is_logged_anew', 'is_cut'), [(False, False), (True, True)])
@pytest.mark.parametrize('outside', ['', '/image', '/attitude /velocity'])
@pytest.mark.parametrize('order', ORDERS)
def test_an_image_is_read_wherever_it_is_in_the_file(
    tmp_path, small_chunks, order, outside, is_logged_anew, is_cut
) -> None:
    """Each with its telemetry and pixels, in stamps that go back once at most."""
    source = write(tmp_path / 'bag', recording())
    images = read_images([source], '/image')
    pixels = {image.time_ns: image.pixels for image in images if isinstance(image, Image)}
    bag = rewritten(source, tmp_path / 'b.mcap', order, outside, is_logged_anew)
    if is_cut:  # as by a crash before the summary was written
        content = bag.read_bytes()
        bag.write_bytes(content[: content.rindex(b'\x0f\x04' + bytes(7))])
    said: list[str] = []
    full, stamps_ns = read_telemetry([source], TOPICS, OPTIONS), []
    for frame in read_frames([bag], TOPICS, OPTIONS, said.append):
        assert isinstance(frame, Frame)
        stamps_ns.append(frame.image.time_ns)
        np.testing.assert_array_equal(frame.image.pixels, pixels[stamps_ns[-1]])
        np.testing.assert_array_equal(numbers_of(frame), full.numbers_at(stamps_ns[-1]))
    assert sorted(stamps_ns) == sorted(pixels)
    assert np.count_nonzero(np.diff(stamps_ns) < 0) <= 1
    assert [text for text in said if 'truncated' not in text] == []
