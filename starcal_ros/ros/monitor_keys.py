# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Requests to the calibrator by keys of ``starcal monitor``."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import select
import sys
import termios
import tty
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from starcal.srv import Calibrate

_SERVICES = {'c': 'calibrate', 's': 'solve', 'b': 'rollback', 'x': 'reset'}
_TRIED = ('solve',)  # a dry run changes nothing, so it needs no confirmation
HELP = 'c calibrate   s solve, dry run   b roll back   x reset   q quit'


class Keys:
    """
    Calls services of the calibrator; a key that changes its state must be followed by ``y``.

    `line` is the help, a question, or the last answer.
    """

    def __init__(self, node: Node) -> None:
        # Relative names, so that a namespace or a remap leads to another calibrator.
        self._clients = {
            name: node.create_client(
                Calibrate if name == 'solve' else Trigger,
                node.resolve_service_name(f'calibrator/{name}'),
            )
            for name in _SERVICES.values()
        }
        self._asked = self._wanted = ''
        self._future: Any = None
        self._answer = ''

    def line(self) -> str:
        """Text to show above the panels; sends a pending request once the service exists."""
        if self._asked:
            return f'{self._asked}: press y to confirm, any other key to cancel'
        if not self._wanted:
            return f'{HELP}\n{self._answer}' if self._answer else HELP
        client = self._clients[self._wanted]
        if self._future is None:
            if not client.service_is_ready():
                return f'{self._wanted}: no service {client.srv_name} yet'
            request = (
                Calibrate.Request(dry_run=True) if self._wanted in _TRIED else Trigger.Request()
            )
            self._future = client.call_async(request)
        if not self._future.done():
            return f'{self._wanted}: no answer yet'
        self._answer = f'{self._wanted}: {self._future.result().message}'
        self._wanted, self._future = '', None
        return f'{HELP}\n{self._answer}'

    def press(self, key: str) -> None:
        """Handle a key; a key that is not in `HELP` cancels a question."""
        asked, self._asked = self._asked, ''
        name = asked if key == 'y' else _SERVICES.get(key, '')
        if not name or (asked and key != 'y') or self._future is not None:
            return
        if asked or name in _TRIED:
            self._wanted = name
        else:
            self._asked = name


@contextlib.contextmanager
def single_keys() -> Iterator[bool]:
    """Set the terminal to unbuffered keys without echo; False if there is no terminal."""
    if not sys.stdin.isatty():
        yield False
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield True
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def pressed() -> str:
    """Keys pressed since the last call."""
    number = sys.stdin.fileno()
    if not select.select([number], [], [], 0.0)[0]:
        return ''
    return os.read(number, 64).decode(errors='ignore')
