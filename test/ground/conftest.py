# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The tool in the process of the tests."""

from __future__ import annotations

import pytest
from starcal_tool import Answer, Starcal  # type: ignore[import-not-found]


@pytest.fixture
def starcal(capsys: pytest.CaptureFixture[str]) -> Starcal:
    """Run the tool with words of a command line; the answer has what it prints from then on."""
    from starcal_ground.cli.main import main

    def run(*words: object) -> Answer:
        capsys.readouterr()
        try:
            status = main([str(word) for word in words])
        except SystemExit as ended:  # argparse's way out
            status = int(str(ended.code or 0))
        return Answer(status, *capsys.readouterr())

    return run
