# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Print the test files nearest to what changed: ``python tools/tests_of_change.py [REF]``.

A changed test file is its own.  A changed module has the test files that lead to it by the fewest
imports; of those, the ones that bear its name or lie in the folder of tests with the name of its
room, if there are any: a hundred test files import the records, few are about them.  A module that
is loaded by its name has the tests of its room.  The files that differ from `REF`, by default from
the last commit, are changed, and so are new ones.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from pathlib import Path
import subprocess
import sys

TOPS = ('starcal_ros', 'starcal_ground', 'bench', 'studies', 'docs', 'tools', 'test')


def main() -> None:
    """Print the files, one on each line."""
    ref = sys.argv[1] if len(sys.argv) > 1 else 'HEAD'
    names = _lines('git', 'diff', '--name-only', ref)
    names += _lines('git', 'ls-files', '--others', '--exclude-standard')
    print(*nearest_tests(Path(name) for name in names), sep='\n')


def nearest_tests(changed: Iterable[Path]) -> list[Path]:
    """Test files to run for changed files; all paths are relative to the project's root."""
    modules = _modules()
    tests: set[Path] = set()
    for path in changed:
        if path in modules.values():
            tests |= {path} if _is_test(path) else _nearest(path, modules)
    return sorted(tests)


def _nearest(path: Path, modules: dict[str, Path]) -> set[Path]:
    """Test files that lead to a module by the fewest imports, or are those of its room."""
    importers: dict[Path, set[Path]] = {}
    for importer in modules.values():
        for name in _imports(importer) & modules.keys():
            importers.setdefault(modules[name], set()).add(importer)
    seen: set[Path] = set()
    reached = {path}
    while reached and not any(map(_is_test, reached)):
        seen |= reached
        reached = {one for module in reached for one in importers.get(module, ())} - seen
    nearest = {one for one in reached or modules.values() if _is_test(one)}
    own = {
        one
        for one in nearest
        if one.parent.name in path.parent.parts or one.stem.startswith(f'test_{path.stem}')
    }
    return own or (nearest if reached else set())


def _is_test(path: Path) -> bool:
    return path.name.startswith('test_')


def _modules() -> dict[str, Path]:
    """Files by the name of their module; a helper of the tests has no package."""
    paths = [path for top in TOPS for path in Path(top).rglob('*.py')]
    return {_name(path): path for path in paths}


def _name(path: Path) -> str:
    in_package = '.'.join(path.with_suffix('').parts).removesuffix('.__init__')
    return path.stem if path.parent == Path('test') else in_package


@cache
def _imports(path: Path) -> set[str]:
    """Names that a file imports, at its top or within a function."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f'{node.module}.{one.name}' for one in node.names)}
        elif isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
    return names


def _lines(*command: str) -> list[str]:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()


if __name__ == '__main__':
    main()
