# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Pictures and reports beside a result, which is complete without them."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib

from starcal_ros.cli.arguments import complain, is_interrupt
from starcal_ros.errors import StarcalError


class Drawings:
    """Drawings of one result; one that fails costs a line on stderr, once for each kind."""

    def __init__(self) -> None:
        self._failed: set[str] = set()

    @contextlib.contextmanager
    def kind(self, name: str) -> Iterator[None]:
        """End the block quietly where drawing fails; writing belongs outside of it."""
        try:
            yield
        # Other versions of matplotlib, Jinja2 and OpenCV fail in their own ways.
        except Exception as error:
            if is_interrupt(error):
                raise
            if name not in self._failed:
                self._failed.add(name)
                kind = '' if isinstance(error, StarcalError) else f'{type(error).__name__}: '
                complain(f'warning: no {name}, the other results are complete: {kind}{error}')
