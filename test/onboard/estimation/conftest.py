# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The usual four images and their dense problem, for the tests of a session."""

from four_images import Dense, Small, usual  # type: ignore[import-not-found]
import pytest


@pytest.fixture(scope='session')
def given() -> Small:
    return usual()[0]


@pytest.fixture(scope='session')
def truth() -> Dense:
    return usual()[1]
