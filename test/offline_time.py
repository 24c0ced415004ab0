# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Times of astropy that fetch no leap seconds, as they do where its own are of last year."""

from astropy.time import Time
from astropy.utils import iers

__all__ = ['Time']

iers.conf.auto_download = False
iers.conf.auto_max_age = None
iers.conf.iers_leap_second_auto_url = iers.conf.ietf_leap_second_auto_url = ''
