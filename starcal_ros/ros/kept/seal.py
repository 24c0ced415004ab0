# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Seals of state files: a checksum against damage and, with a key, an HMAC against forgery.

A checksum can be computed again by anyone who changes a file; an HMAC only with the key.  Neither
shows that an old file was put back, or that one was removed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import hashlib
import hmac
import json
from pathlib import Path
from typing import Any

from starcal_ros.errors import OptionError
from starcal_ros.untrusted import json_value, read_bytes

_LEAST_KEY_BYTES, _MOST_KEY_BYTES = 16, 4096
_CHECKSUM, _HMAC = 'sha256', 'hmac_sha256'


@dataclass(frozen=True)
class Seal:
    """Seals files with a checksum, and with an HMAC where ``key`` is not empty."""

    key: bytes = b''

    def sealed(self, content: Mapping[str, object]) -> str:
        """JSON text of an object, with its checksum and HMAC as the last keys."""
        text = _canonical(content)
        seals = {_CHECKSUM: hashlib.sha256(text).hexdigest()}
        if self.key:
            seals[_HMAC] = self._hmac(text)
        return json.dumps({**content, **seals}, indent=1, allow_nan=False) + '\n'

    def opened(self, data: bytes) -> dict[str, Any]:
        """
        The JSON object of a sealed file, without its seals.

        Raises ValueError when it is no JSON object, or a seal is missing or wrong.
        """
        content = json_value(data.decode())
        if not isinstance(content, dict):
            raise ValueError('not a JSON object')
        checksum, found = content.pop(_CHECKSUM, None), content.pop(_HMAC, None)
        text = _canonical(content)
        if checksum != hashlib.sha256(text).hexdigest():
            raise ValueError('the checksum is wrong')
        self._check(found, text)
        return content

    def mark(self, number: int, data: bytes) -> str:
        """HMAC of a numbered file, for its name; empty without a key."""
        return self._hmac(_numbered(number, data)) if self.key else ''

    def check_mark(self, mark: str, number: int, data: bytes) -> None:
        """
        Compare the HMAC in the name of a file with its content; does nothing without a key.

        Raises ValueError when it is missing or wrong.
        """
        self._check(mark, _numbered(number, data))

    def _check(self, found: object, text: bytes) -> None:
        if not self.key:
            return
        if not found:
            raise ValueError('the HMAC is missing (state_key_file)')
        if not hmac.compare_digest(str(found).encode(), self._hmac(text).encode()):
            raise ValueError('the HMAC is wrong (state_key_file)')

    def _hmac(self, text: bytes) -> str:
        return hmac.new(self.key, text, 'sha256').hexdigest()


CHECKSUMS = Seal()
"""The seal without a key."""


def read_seal(key_file: str) -> Seal:
    """
    The seal with the key in a file; '' for checksums alone.

    Raises OptionError when the file cannot be read, or the key is too short or too long.
    """
    if not key_file:
        return Seal()
    try:
        key = read_bytes(Path(key_file), _MOST_KEY_BYTES).strip()
    except OSError as error:
        raise OptionError(f'state_key_file: {key_file}: {error.strerror}') from error
    except ValueError as error:
        raise OptionError(f'state_key_file: {key_file}: {error}') from error
    if len(key) < _LEAST_KEY_BYTES:
        raise OptionError(
            f'state_key_file: {key_file} holds {len(key)} bytes, at least {_LEAST_KEY_BYTES} are '
            'needed (openssl rand -hex 32)'
        )
    return Seal(key)


def _canonical(content: Mapping[str, object]) -> bytes:
    # Numbers are written with the digits that read back to the same double, so the text is unique.
    return json.dumps(content, sort_keys=True, separators=(',', ':')).encode()


def _numbered(number: int, data: bytes) -> bytes:
    return f'{number}:'.encode() + data
