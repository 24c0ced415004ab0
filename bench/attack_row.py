# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A row of the table of ``python -m bench attack``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AttackRow:
    """
    An attack and its outcome.

    Attributes
    ----------
    attack : str
    tried : int
        Attempts.
    survived : int
        Of these, the ones that were refused or endured in one line: no traceback, no hang, no
        process ended that should not have.
    lost : int
        Files or records that were sound before and are not afterwards.
    wrong : int
        Wrong results that were accepted as right.
    note : str
    """

    attack: str
    tried: int
    survived: int
    lost: int
    wrong: int
    note: str = ''
