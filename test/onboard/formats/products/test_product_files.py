# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files: whole, or not at all."""

from __future__ import annotations

import pytest

from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import write_atomically


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch) -> None:
    path = tmp_path / 'c.json'
    write_atomically(path, 'old')

    def full(_: int) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(ProductError, match='No space left'):
        write_atomically(path, 'new')
    assert path.read_text() == 'old'
    assert list(tmp_path.iterdir()) == [path]
