"""The words of `starcal diagnose`, and of the commands that end with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcal_ros.diagnosis.bags import diagnose_bags
from starcal_ros.diagnosis.diagnose import Diagnosis
from starcal_ros.errors import BagError
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
    """A diagnosis in words."""
    lines = [found.sentence, '', 'how it is known:', *(f'  {line}' for line in found.evidence)]
    if found.mend:
        lines += ['', 'in the parameter file:', *(f'  {line}' for line in found.mend)]
    return '\n'.join(lines)


def in_a_sentence(paths: Sequence[Path], asked: Topics, setup: Setup) -> str:
    """The diagnosis of bags as the end of a complaint; empty where it finds nothing wrong."""
    try:
        found = diagnose_bags(paths, asked, setup)
    except BagError:
        return ''
    return '' if found.cause == 'none' else found.in_a_sentence()
