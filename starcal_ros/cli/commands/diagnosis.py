# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The words of `starcal diagnose`, and of the commands that end with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcal_ros.diagnosis.bags import diagnose_bags
from starcal_ros.diagnosis.diagnose import Diagnosis
from starcal_ros.errors import BagError
from starcal_ros.pipeline.inspect import Refused
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.topics import Topics


def content(found: Diagnosis) -> dict[str, object]:
    """A diagnosis as a JSON object."""
    return {
        'cause': found.cause,
        'found': found.found,
        'also': list(found.also),
        'sentence': found.sentence,
        'evidence': list(found.evidence),
        'mend': list(found.mend),
    }


def text(found: Diagnosis) -> str:
    """Diagnosis as text for a terminal."""
    lines = [found.sentence, '', 'evidence:', *(f'  {line}' for line in found.evidence)]
    if found.mend:
        lines += ['', 'in the parameter file:', *(f'  {line}' for line in found.mend)]
    return '\n'.join(lines)


def of_a_failure(
    paths: Sequence[Path], asked: Topics, setup: Setup, refused: Sequence[Refused]
) -> Diagnosis | None:
    """The diagnosis of bags whose images are all refused; None where it finds nothing wrong."""
    try:
        found = diagnose_bags(paths, asked, setup, refused)
    except BagError:
        return None
    return None if found.cause == 'none' else found
