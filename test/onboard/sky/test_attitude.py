# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitude samples: validation, order, interpolation, refusals."""

import math
import tracemalloc
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ImageRefused
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory

S = 1_000_000_000  # nanoseconds
START_NS = 1_778_829_600 * S + 123_456_789  # a stamp of today: seconds in a double are 0.2 us off
DIRECT = 'st_to_inertial'


def history(samples: list[tuple[int, np.ndarray]], **kwargs: float) -> AttitudeHistory:
    made = AttitudeHistory(**kwargs)
    for time_ns, q in samples:
        made.add(time_ns, attitude_sample(time_ns, q, DIRECT))
    return made


def random_quaternions(seed: int, n: int) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(n, 4))
    return np.asarray(q / np.linalg.norm(q, axis=1)[:, None])


def slerp(q0: np.ndarray, q1: np.ndarray, t: float) -> np.ndarray:
    """Spherical interpolation by Shoemake's formula, along the shorter arc."""
    cosine = float(q0 @ q1)
    if cosine < 0:
        q1, cosine = -q1, -cosine
    angle = math.acos(min(cosine, 1.0))
    if angle < 1e-12:
        return q0
    return (math.sin((1 - t) * angle) * q0 + math.sin(t * angle) * q1) / math.sin(angle)


def angle_between(q0: np.ndarray, q1: np.ndarray) -> float:
    return float((Rotation.from_quat(q0).inv() * Rotation.from_quat(q1)).magnitude())


def refusal(held: AttitudeHistory, time_ns: int, max_gap_s: float = 2.0) -> str:
    with pytest.raises(ImageRefused) as refused:
        held.at(time_ns, max_gap_s)
    assert refused.value.detail
    return refused.value.reason


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('t', [1e-9, 0.25, 0.5, 0.9])
def test_interpolation_is_slerp(seed: int, t: float) -> None:
    q0, q1 = random_quaternions(seed, 2)
    between_ns = START_NS + round(t * S)
    found, gap_s = history([(START_NS, q0), (START_NS + S, q1)]).at(between_ns, 2.0)
    assert gap_s == 1.0
    # acos loses half its digits next to 1; these quaternions are far apart: 1e-13 rad.
    assert angle_between(found, slerp(q0, q1, round(t * S) / S)) < 1e-12
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-15)


def test_both_directions_mean_one_rotation() -> None:
    q = random_quaternions(1, 1)[0]
    inverse = Rotation.from_quat(q).inv().as_quat()
    for sent, direction in ((q, 'st_to_inertial'), (inverse, 'inertial_to_st')):
        sample = attitude_sample(START_NS, sent, direction)
        assert sample is not None
        assert angle_between(sample.icrf_from_star_tracker_xyzw, q) < 1e-15


@pytest.mark.parametrize(
    'q',
    [
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.002],
        [0.0, 0.0, 0.0, 0.998],
        [math.nan, 0.0, 0.0, 1.0],
        [math.inf, 0.0, 0.0, 1.0],
        [1e200, 1e200, 0.0, 0.0],
    ],
)
@pytest.mark.filterwarnings('ignore:overflow encountered')
def test_no_rotation_is_no_sample(q: list[float]) -> None:
    for direction in ('st_to_inertial', 'inertial_to_st'):
        assert attitude_sample(START_NS, np.array(q), direction) is None


def test_a_rounded_quaternion_is_made_unit() -> None:
    q = random_quaternions(2, 1)[0]
    sample = attitude_sample(START_NS, 1.0005 * q, DIRECT)
    assert sample is not None
    # Two units in the last place: one of the product, one of the division.
    np.testing.assert_allclose(sample.icrf_from_star_tracker_xyzw, q, rtol=0, atol=2.3e-16)


def test_of_two_samples_with_one_stamp_the_first_stands() -> None:
    q0, q1, q2 = random_quaternions(5, 3)
    once = history([(START_NS, q0), (START_NS + S, q1)])
    twice = history([(START_NS, q0), (START_NS, q2), (START_NS + S, q1), (START_NS + S, q2)])
    assert len(twice) == 2
    for dt_ns in (0, S // 3, S):
        a, b = (held.at(START_NS + dt_ns, 2.0)[0] for held in (once, twice))
        np.testing.assert_array_equal(a, b)


def test_a_valid_sample_takes_the_place_of_an_invalid_one_of_its_stamp() -> None:
    q0 = random_quaternions(6, 1)[0]
    held = AttitudeHistory()
    held.add(START_NS, None)
    assert refusal(held, START_NS) == 'bad_attitude'
    for sample in (attitude_sample(START_NS, q0, DIRECT), None):
        held.add(START_NS, sample)
        found, gap_s = held.at(START_NS, 0.0)  # the sample at the image needs no other
        # Made unit once more: two roundings.
        np.testing.assert_allclose(found, q0, rtol=4e-16)
        assert gap_s == 0.0


@pytest.mark.parametrize(
    ('valid_s', 'invalid_s', 'at_s', 'max_gap_s', 'reason'),
    [
        ((), (), 0.0, 2.0, 'no_attitude'),
        ((0, 1), (), -1e-9, 2.0, 'no_attitude'),
        ((0, 1), (), 1.0 + 1e-9, 2.0, 'no_attitude'),
        ((0, 2), (), 1.0, 2.0, ''),
        ((0, 2), (), 1.0, 2.0 - 1e-9, 'attitude_gap'),
        # The neighbours on both sides are near enough: the invalid one is passed over.
        ((0, 2), (1,), 1.0 + 1e-9, 2.0, ''),
        ((0, 2), (1,), 1.0, 2.0, 'bad_attitude'),
        ((0, 2), (1,), 1.0 + 1e-9, 1.5, 'bad_attitude'),
        ((0, 2), (1, 3), 3.0 - 1e-9, 2.0, 'bad_attitude'),
        ((0, 2), (-1, 1), -1e-9, 2.0, 'bad_attitude'),
    ],
)
def test_samples_that_give_no_attitude_are_named(
    valid_s, invalid_s, at_s, max_gap_s, reason
) -> None:
    quaternions = random_quaternions(11, len(valid_s))
    held = history([(START_NS + t * S, q) for t, q in zip(valid_s, quaternions, strict=True)])
    for t in invalid_s:
        held.add(START_NS + t * S, None)
    time_ns = START_NS + round(at_s * S)
    if reason:
        assert refusal(held, time_ns, max_gap_s) == reason
    else:
        assert held.at(time_ns, max_gap_s)[1] == 2.0


def test_the_last_seconds_are_kept_and_at_most_as_many_before_them() -> None:
    held = history([], keep_s=5.0)
    for k, quaternion in enumerate(random_quaternions(12, 20)):
        held.add(START_NS + k * S, attitude_sample(START_NS + k * S, quaternion, DIRECT))
        assert min(k + 1, 6) <= len(held) <= 12
    assert held.at(START_NS + 14 * S, 2.0)[1] == 0.0
    assert refusal(held, START_NS + 14 * S - 1) == 'no_attitude'


def steady(rate_hz: float, start_ns: int = START_NS) -> list[tuple[int, np.ndarray]]:
    """A minute of samples of a slow rotation about z, 1 mrad/s."""
    stamps = [start_ns + round(k / rate_hz * S) for k in range(int(rate_hz * 60.0) + 1)]
    return [(stamp, turned(stamp)) for stamp in stamps]


def turned(time_ns: int) -> np.ndarray:
    half = 0.5e-3 * (time_ns - START_NS) / S
    return np.array([0.0, 0.0, math.sin(half), math.cos(half)])


@pytest.mark.parametrize('rate_hz', [0.5, 1.0, 10.0, 100.0])
def test_any_rate_late_doubled_and_out_of_order(rate_hz: float) -> None:
    """The attitude of a steady rotation does not depend on rate or order of its samples."""
    rng = np.random.default_rng(13)
    samples = steady(rate_hz)
    late_s = rng.uniform(0.0, 8.0, len(samples))  # some overtake hundreds of others
    order = np.argsort([t for t, _ in samples] + late_s * S)
    came = [samples[k] for k in order]
    came += [came[k] for k in rng.integers(0, len(came), 20)]  # the doubled ones, very late
    held = history(came, keep_s=3600.0, jump_s=10.0)
    for time_ns in START_NS + rng.integers(S, 59 * S, 50):
        # Slerp of a steady turn is exact; half angles of 0.06 rad have 1e-17 in a double.
        assert angle_between(held.at(int(time_ns), 2.0)[0], turned(time_ns)) < 1e-14


@pytest.mark.parametrize('wrong_s', [-(10**9), -4000, -60, 60, 4000, 10**9, 9 * 10**8])
def test_one_wrong_stamp_costs_nothing(wrong_s: int) -> None:
    """A sample stamped in the future does not make the others too old to keep."""
    samples = steady(10.0)
    wrong = (samples[300][0] + wrong_s * S, random_quaternions(14, 1)[0])
    held = history([*samples[:300], wrong, *samples[301:]], keep_s=3600.0, jump_s=10.0)
    assert_steady(held, samples, (1, 29, 31, 59))


def assert_steady(
    held: AttitudeHistory, samples: list[tuple[int, np.ndarray]], at_s: tuple[int, ...]
) -> None:
    assert held.latest_ns == samples[-1][0]
    for dt_s in at_s:
        time_ns = START_NS + dt_s * S + S // 3
        found, gap_s = held.at(time_ns, 2.0)
        assert gap_s == pytest.approx(0.1)
        assert angle_between(found, turned(time_ns)) < 1e-14


@pytest.mark.parametrize('back_s', [30, 600, 100_000])
def test_a_clock_set_back_is_believed(back_s: int) -> None:
    """Samples of the previous and the present clock do not mix; the present ones come first."""
    other = random_quaternions(15, 1)[0]
    before = [(t, other) for t, _ in steady(10.0, START_NS + (back_s - 30) * S)]
    now = steady(10.0)
    assert_steady(history([*before, *now], keep_s=3600.0, jump_s=10.0), now, (1, 31, 59))


def test_memory_of_a_fast_tracker_is_bounded() -> None:
    """90 s at 100 Hz, 20 s kept: 2000 samples of 40 bytes, at most four times that."""
    held = AttitudeHistory(keep_s=20.0, jump_s=10.0)
    sample = attitude_sample(START_NS, np.array([0.0, 0.0, 0.0, 1.0]), DIRECT)
    tracemalloc.start()
    for k in range(9_000):
        held.add(START_NS + k * S // 100, sample)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 2001 <= len(held) <= 4002
    # Twice for what is forgotten but not yet moved, twice for the copy that moves the rest.
    assert peak_bytes < 2000 * 40 * 4


SIGMA_RAD = np.full(3, 10.0 * ARCSECOND_RAD)


def sampled(at_s: Any, attitudes: Rotation) -> AttitudeHistory:
    """Samples at times, s."""
    stamps_ns = (START_NS + round(t * S) for t in at_s)
    return history(list(zip(stamps_ns, attitudes.as_quat(), strict=True)))


def turning(rate_rad_s: np.ndarray, at_s: tuple[float, ...]) -> AttitudeHistory:
    """Samples of a star tracker that turns at a constant rate about axes of its own."""
    start = Rotation.from_quat(random_quaternions(3, 1)[0])
    return sampled(at_s, start * Rotation.from_rotvec(np.outer(at_s, rate_rad_s)))


def test_the_rate_is_that_about_the_own_axes() -> None:
    """Also at a sample's own stamp, where a node has no later one yet, and of 500 a second."""
    rate_rad_s = np.array([0.01, -0.03, 0.02])
    held = turning(rate_rad_s, (0.0, 0.5, 1.0, 2.5))
    for t in (0.1, 0.5, 0.9, 1.0, 1.8, 2.5):
        found, sigma = held.rate_at(START_NS + round(t * S), 2.0, SIGMA_RAD)
        np.testing.assert_allclose(found, rate_rad_s, atol=1e-9)
        # Of two samples, a line through three: nothing shows how they scatter.
        assert (sigma >= SIGMA_RAD / np.sqrt(2.0)).all()
    fast = turning(rate_rad_s, tuple(np.arange(-1.2, 1.2, 0.002)))
    assert len(fast) == 1200
    found, _ = fast.rate_at(START_NS, 2.0, SIGMA_RAD)
    np.testing.assert_allclose(found, rate_rad_s, atol=1e-9)


ARC_10_HZ = tuple(np.arange(-0.95, 1.0, 0.1))


@pytest.mark.parametrize(
    ('at_s', 'memory_s', 'low', 'high'),
    [
        (ARC_10_HZ, 0.0, 0.3, 0.6),
        ((-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0), 0.0, 0.5, 0.9),
        (ARC_10_HZ, 0.5, 0.7, 1.15),  # filtered: they scatter less about a slope than it is off
        (tuple(t for t in ARC_10_HZ if not -0.5 < t < 0.2), 0.0, 0.3, 0.6),  # a dropout
        (tuple(t for t in ARC_10_HZ if t < 0.2), 0.0, 0.5, 1.0),  # the last image
        ((-0.93, -0.9, -0.41, 0.02, 0.11, 0.6, 0.97), 0.0, 0.5, 0.9),  # at no fixed rate
        ((-0.05, 0.05), 0.0, 0.8, 1.2),
        ((-1.0, 1.0), 0.0, 0.8, 1.2),
        ((-0.3, 0.1, 0.9), 0.0, 0.6, 1.2),
    ],
)
def test_the_sigma_of_a_rate_is_its_scatter(at_s, memory_s, low, high) -> None:
    """Error over sigma, rms; the errors of samples may be correlated, and here mostly are not."""
    rng = np.random.default_rng(7)
    apart_s = np.abs(np.subtract.outer(at_s, at_s))
    K = np.exp(-apart_s / memory_s) if memory_s else np.eye(len(at_s))
    root = SIGMA_RAD[0] * np.linalg.cholesky(K)
    rate_rad_s = np.radians([0.1, -0.05, 0.3])
    true = Rotation.from_rotvec(np.outer(at_s, rate_rad_s))
    in_sigma = []
    for _ in range(200):
        errors = Rotation.from_rotvec(root @ rng.normal(size=(len(at_s), 3)))
        rate, sigma = sampled(at_s, true * errors).rate_at(START_NS, 2.0, SIGMA_RAD)
        in_sigma.append((rate - rate_rad_s) / sigma)
    assert low < np.sqrt(np.mean(np.square(in_sigma))) < high


def test_a_camera_that_speeds_up_has_the_rate_of_the_image() -> None:
    """Samples up to 0.2 s after the image: their mean rate is that of 0.4 s before."""
    at_s = np.arange(-0.95, 0.2, 0.1)
    angle = 0.01 * at_s + 0.5 * 0.02 * at_s**2
    held = sampled(at_s, Rotation.from_rotvec(np.outer(angle, [0.0, 1.0, 0.0])))
    rate, _ = held.rate_at(START_NS, 2.0, SIGMA_RAD)
    np.testing.assert_allclose(rate, [0.0, 0.01, 0.0], atol=1e-5)


def test_a_rate_that_no_two_samples_show_is_not_known() -> None:
    held = turning(np.array([0.0, 0.0, 0.1]), (0.0, 3.0))
    for t, why in ((0.0, 'no sample before'), (1.0, 'too far apart'), (3.0, 'too far before')):
        assert np.isnan(held.rate_at(START_NS + round(t * S), 2.0, SIGMA_RAD)).all(), why
    held.add(START_NS + 2 * S, None)
    assert np.isnan(held.rate_at(START_NS + 2 * S, 2.0, SIGMA_RAD)).all()
    assert np.isnan(AttitudeHistory().rate_at(START_NS, 2.0, SIGMA_RAD)).all()
