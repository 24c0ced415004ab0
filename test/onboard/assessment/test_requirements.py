# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Requirements: what is understood, the sigma each limits, and the answer; remedies."""

import dataclasses
from pathlib import Path
import re

import numpy as np
import pytest
from sample_records import calibration  # type: ignore[import-not-found]

import starcal_ros
from starcal_ros.assessment.gate import reasons_of
from starcal_ros.assessment.remedies import REMEDIES, remedy_against
from starcal_ros.assessment.requirements import Requirement, requirement_checks, requirements_of
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.unknowns import UNKNOWNS
from starcal_ros.options import names_of
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    DetectorMaps,
    IMAGE_REFUSALS,
    SigmaPart,
    Statement,
)

CAMERA = CameraModel(640, 512, np.r_[1800.0, 0.0, 1801.0, 319.5, 255.5, np.zeros(5)])
SIGMA = np.r_[0.1, 0.0, 0.2, 0.3, 0.4, 5 * [0.01], 3 * [4.0 * ARCSECOND_RAD]]
# 100 cells: ninety of 3", nine of 6" and one of 9".
CELLS = np.repeat([3.0, 6.0, 9.0], [90, 9, 1]).reshape(10, 10)


FOUND: Calibration = dataclasses.replace(
    calibration(),
    geometry=CameraGeometry(CAMERA, np.array([0.0, 0.0, 0.0, 1.0])),
    covariance=np.diag(SIGMA**2),
    maps=DetectorMaps(np.ones((10, 10), np.int64), CELLS, CELLS / 10),
    sigma_budget=(SigmaPart('total', 0.3, 3.5, ''),),
    field=None,
)


@pytest.mark.parametrize(
    ('text', 'sigma', 'note'),
    [
        ('line_of_sight=5arcsec', 9.0, 'missed by 4 arcsec'),
        ('line_of_sight=5arcsec@98%', 6.0, 'missed by 1 arcsec'),
        ('line_of_sight = 5 arcsec @ 90 %', 3.0, 'met'),
        ('map=0.5arcsec', 0.9, 'missed by 0.4 arcsec'),
        ('map=0.5arcsec@90%', 0.3, 'met'),
        ('pointing=3arcsec', 3.5, 'missed by 0.5 arcsec'),
        ('f=0.15px', 0.2, 'missed by 0.05 px'),
        ('fx=0.1px', pytest.approx(0.1), 'met'),
        ('k1=0.001', 0.01, 'missed by 0.009'),
        ('alignment_x=5arcsec', pytest.approx(4.0), 'met'),
        ('skew=1px', pytest.approx(np.nan, nan_ok=True), 'it is not estimated'),  # held
        ('k6=1', pytest.approx(np.nan, nan_ok=True), 'it is not estimated'),  # another lens
    ],
)
def test_each_sigma_and_its_answer(text: str, sigma: float, note: str) -> None:
    (check,) = requirement_checks(FOUND, [text])
    assert (check.found, check.option) == (sigma, 'requirements')
    assert (check.note, check.passed) == (note, note == 'met')


def test_the_map_in_pixels() -> None:
    """1 px of each focal length at the corner, 0.227 focal lengths off the axis."""
    covariance = np.diag(np.r_[1.0, 0.0, 1.0, np.zeros(10)])
    found = dataclasses.replace(FOUND, covariance=covariance)
    # The curvature of the field takes 4 % off.
    assert Requirement.of('map=1px').sigma(found) == pytest.approx(0.227, rel=0.05)
    half, whole = (Requirement.of(f'map=1px@{share}%').sigma(found) for share in (50, 100))
    assert half < 0.7 * whole


def test_the_camera_alone_has_its_own_lines_of_sight() -> None:
    alone = dataclasses.replace(FOUND, parent_frame='')
    assert not alone.has_alignment
    assert Requirement.of('line_of_sight=5arcsec').sigma(alone) == 0.9
    for text in ('pointing=5arcsec', 'alignment_z=100arcsec'):
        assert np.isnan(Requirement.of(text).sigma(alone))


def with_causes(*causes: SigmaPart) -> Calibration:
    total = SigmaPart('total', 1.0, 9.0, '', (1.0,) * 62 + (20.0,))
    return dataclasses.replace(FOUND, sigma_budget=(total, *causes))


def test_what_is_missed_names_what_lowers_that_sigma_most() -> None:
    """The stars are the largest cause in a corner, the read-out elsewhere, a slow error of all."""
    found = with_causes(
        SigmaPart('read-out', 0.8, 0.8, '', (0.8,) * 63),
        SigmaPart('stars', 0.6, 0.7, '', (0.5,) * 62 + (19.0,)),
        SigmaPart('star tracker slow error', 0.0, 8.9, '', (0.0,) * 63),
    )
    texts = 'map=1e-3arcsec', 'line_of_sight=1arcsec', 'f=1e-3px', 'pointing=0.1arcsec'
    notes = [check.note.partition('; ')[2] for check in requirement_checks(found, texts)]
    slow = remedy_against('star tracker slow error')
    assert notes == ['take more images', 'take more images', 'take more images', slow]
    # A calibration of an earlier version has no causes at pixels.
    parts = [dataclasses.replace(part, map_over_detector_arcsec=()) for part in found.sigma_budget]
    without = dataclasses.replace(found, sigma_budget=tuple(parts))
    notes = [check.note.partition('; ')[2] for check in requirement_checks(without, texts)]
    assert notes == [remedy_against('read-out'), slow, remedy_against('read-out'), slow]


def test_a_missed_requirement_has_the_gain_of_stating_its_largest_cause() -> None:
    """In the figures of that requirement, with a word where they do not reach it."""
    slow = 'star tracker slow error'
    found = dataclasses.replace(
        with_causes(SigmaPart('stars', 0.6, 0.7, ''), SigmaPart(slow, 0.0, 8.9, '')),
        statements=(
            Statement('velocity', 'known', 'pointing', 9.0, 1.0, 'velocity'),
            Statement('star_tracker_slow_arcsec', '5', 'pointing', 9.0, 1.4, slow),
        ),
    )
    texts = (
        *('line_of_sight=8arcsec', 'line_of_sight=4arcsec@98%', 'pointing=1arcsec'),
        *('alignment_x=0.1arcsec', 'map=1e-3arcsec'),
    )
    notes = [check.note.partition('; ')[2] for check in requirement_checks(found, texts)]
    state = 'state star_tracker_slow_arcsec'
    # The statement leaves the 20″ of the camera in one corner, and elsewhere 1.4″ of 9″.
    assert notes == [
        f'{state}: 9 arcsec becomes 8.2 arcsec if it is 5, not enough',
        f'{state}: 6 arcsec becomes 0.93 arcsec if it is 5',
        f'{state}: 9 arcsec becomes 1.4 arcsec if it is 5, not enough',
        state,
        'take more images',
    ]


def test_the_reason_that_a_requirement_is_missed_has_at_most_200_characters() -> None:
    maps = DetectorMaps(np.ones((10, 10), np.int64), 1234.5 * CELLS, 123.45 * CELLS)
    texts = 'line_of_sight=1234arcsec', 'map=123.4arcsec@99.5%', 'pointing=1.234arcsec'
    causes = list(REMEDIES)[list(REMEDIES).index('stars') :]
    causes += {kind.cause for kind in UNKNOWNS.values() if kind.cause}
    for cause in (*causes, 'other'):  # some have no remedy
        parts = with_causes(SigmaPart(cause, 1.0, 9.0, ''))
        reasons = reasons_of(requirement_checks(dataclasses.replace(parts, maps=maps), texts))
        assert len(reasons) == 3 and max(map(len, reasons)) <= 200
        assert all(reason.endswith(remedy_against(cause) or 'arcsec') for reason in reasons)


def test_one_focal_length_that_is_held_is_no_sigma_of_both() -> None:
    for held in (0, 2):
        covariance = FOUND.covariance.copy()
        covariance[held, held] = 0.0
        one_held = dataclasses.replace(FOUND, covariance=covariance)
        assert np.isnan(Requirement.of('f=1px').sigma(one_held))


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('5arcsec', 'is not of the form line_of_sight=5arcsec@98%'),
        ('line_of_site=5arcsec', 'did you mean line_of_sight?'),
        ('line_of_sight=5px', 'write line_of_sight=5arcsec'),
        ('map=5', 'write map=5arcsec or map=5px'),
        ('k1=1px', 'write k1=1'),
        ('f=0.1px@98%', 'only line_of_sight and map are over a share'),
        ('map=0px', 'finite and above 0, and the share at most 100 %'),
        ('map=1e999px', 'finite and above 0'),
        ('map=nanpx', 'is not of the form'),
        ('map=1px@101%', 'above 0, and the share at most 100 %'),
        ('', 'leave the option out for the defaults, or write none'),
    ],
)
def test_what_is_not_understood_is_named(text: str, words: str) -> None:
    """A word states that there is none; beside others it is not understood."""
    assert requirements_of(['none']) == ()
    for texts in ([text], ['map=1px', text]):
        with pytest.raises(OptionError, match='^requirements: ') as refused:
            requirements_of(texts)
        assert words in str(refused.value)
    with pytest.raises(OptionError, match='none'):
        requirements_of(['none', 'map=1px'])


OPTIONS = names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
ROOT = Path(starcal_ros.__file__).parents[1]
SOURCE = '\n'.join(
    path.read_text().partition('\nREMEDIES: ')[0]
    for package in ('starcal_ros', 'starcal_ground')
    for path in (ROOT / package).rglob('*.py')
)
OF_UNKNOWNS = [kind.remedy for kind in UNKNOWNS.values() if kind.remedy]
OF_PRIORS = [kind.tested.remedy for kind in UNKNOWNS.values() if kind.tested is not None]


@pytest.mark.parametrize('name', REMEDIES)
def test_each_remedy_is_of_a_refusal_a_check_or_a_cause(name: str) -> None:
    is_written = f"'{name}'" in SOURCE or f'"{name}"' in SOURCE
    assert name in {*IMAGE_REFUSALS, *OPTIONS} or is_written


@pytest.mark.parametrize('text', [*REMEDIES.values(), *OF_UNKNOWNS, *OF_PRIORS])
def test_the_options_of_a_remedy_exist(text: str) -> None:
    assert set(re.findall(r'\b[a-z]\w*_\w+', text)) <= OPTIONS | {'setup_finder'}


def test_no_other_module_has_a_table_of_remedies() -> None:
    assert not re.findall(r'^_?(?:REMED|MEASURES)\w* = \{', SOURCE, re.MULTILINE)
