# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Times of all systems against astropy, which has its own leap seconds and TDB."""

from offline_time import Time  # type: ignore[import-not-found]
import pytest

from starcal_ground.images.time_systems import from_mjd, from_text, system_of, SYSTEMS

DATES = (
    *('1999-01-01T00:00:00', '2016-12-31T23:59:59.5', '2017-01-01T00:00:36'),
    '2026-05-15T07:20:00.25',
)


def utc_ns(time: Time) -> int:
    """Stamp of a time, exact: astropy keeps days and fraction apart."""
    utc = time.utc
    days = utc.jd1 - 2440587.5
    return int(round(days * 86400) * 10**9 + round(utc.jd2 * 86400e9))


@pytest.mark.parametrize('text', DATES)
@pytest.mark.parametrize('system', SYSTEMS)
def test_each_system_agrees_with_astropy(system, text) -> None:
    if system == 'GPS':
        tai = Time(text, scale='tai')
        time = Time(tai.jd1, tai.jd2 + 19 / 86400, format='jd', scale='tai')
    else:
        time = Time(text, scale=system.lower())
    # Two-part days of astropy carry 1e-11 s; a UTC day with a leap second is stretched by it.
    on_leap_day = str(time.utc.isot).startswith(('2016-12-31', '1998-12-31'))
    expected = utc_ns(time)
    if on_leap_day:
        clock = str(Time(time.utc, format='isot', precision=9).value)
        expected = from_text(clock, 'UTC')
    assert abs(from_text(text, system) - expected) <= 20


def test_nanoseconds_are_kept_and_a_modified_julian_date_is_exact_to_a_microsecond() -> None:
    assert from_text('2026-05-15T07:20:00.123456789', 'UTC') % 10**9 == 123456789
    assert from_text('2026-05-15 07:20:00.1234567891', 'UTC') % 10**9 == 123456789
    assert from_text('2026-135T07:20:00', 'UTC') == from_text('2026-05-15T07:20:00Z', 'UTC')
    assert from_text('2026-05-15T00:00', 'UTC') == 1778803200 * 10**9
    day = from_text('2026-05-15T07:20:00', 'UTC')
    assert abs(from_mjd(61175 + 440 / 1440, 'UTC') - day) < 1000  # 7e-12 days, half a microsecond


def test_a_leap_second_is_the_second_after_it() -> None:
    after = from_text('2017-01-01T00:00:00.5', 'UTC')
    assert from_text('2016-12-31T23:59:60.5', 'UTC') == after
    # TAI - UTC was 36 s before it and is 37 s after it.
    assert from_text('2017-01-01T00:00:36.5', 'TAI') == after
    assert from_text('2017-01-01T00:00:37.5', 'TAI') == after


@pytest.mark.parametrize(
    'text',
    ['noon', '2026-05-15', '2026-135', '2026-13-01T00:00:00', '2026-02-30',
     '2026-05-15T24:00:00', '2026-05-15T10:00:60', '2026-400T00:00:00', '1971-12-31T00:00:00',
     '2038-01-19T03:14:08', '２０２６-05-15T00:00:00'],
)  # fmt: skip
def test_what_is_no_time_is_refused(text) -> None:
    with pytest.raises(ValueError, match='is not a|no time of day|1972|2038'):
        from_text(text, 'UTC')


def test_names_of_other_standards_are_known_and_other_systems_are_refused() -> None:
    assert [system_of(name) for name in ('et', 'TDT', 'GPST', '')] == ['TDB', 'TT', 'GPS', 'UTC']
    for name in ('LOCAL', 'MET', 'SCLK', 'UT1', 'TCB'):
        with pytest.raises(ValueError, match=f'{name}.* is not one of UTC, TAI'):
            system_of(name)
