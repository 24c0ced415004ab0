# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Does a test fail when a token of the code is wrong?  ``python -m tools.mutants [FOLDER ...]``.

Draws mutants of the code in the folders, each with one operator, comparison, number or word
changed, and runs the tests that run its line, the shortest case of each test first, until one
fails.  Which tests these are comes from one run of the fast tests under coverage.py; a line that
runs at import has those that run a line with the name that it binds, and one that none of them
runs has the tests nearest to its module.  Each result is a line of the results file, so a run that
was stopped continues there.  All happens in copies of the last commit.
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import as_completed, ThreadPoolExecutor
from dataclasses import dataclass
import io
from itertools import islice
import json
import os
from pathlib import Path
from queue import Queue
import random
import re
import subprocess
import sys
import tempfile
import tokenize

import coverage

from tools.tests_of_change import nearest_tests

FOLDERS = [f'starcal_ros/{room}' for room in ('stars', 'estimation', 'assessment', 'ros')]
PAIRS = [
    pair.split()
    for pair in ['< <=', '> >=', '== !=', '+ -', '* /', '& |', 'and or', 'True False', 'min max']
]
OTHERS = {
    **{one: other for pair in PAIRS for one, other in (pair, pair[::-1])},
    'not': '',
    '~': '',
    '**': '*',
    '//': '/',
    '%': '*',
    '@': '*',
    'any': 'all',
    'all': 'any',
}
MOST_TESTS = 80  # of those that run a line: a survivor takes a minute
TIMEOUT_S = 600  # a mutant that does not end is killed too


@dataclass(frozen=True)
class Tests:
    """Tests by the ``path:line`` that they ran, and the number of lines that each ran."""

    by_line: dict[str, set[str]]
    sizes: dict[str, int]

    def of(self, mutant: Mutant) -> list[str]:
        """Tests that may kill a mutant: one case of each function, then more, shortest first."""
        ran = self.by_line.get(f'{mutant.path}:{mutant.line}')
        if not ran:
            named = re.compile(rf'\b({_bound_by(mutant)})\b')
            ran = {
                test
                for path in Path('starcal_ros').rglob('*.py')
                for line, text in enumerate(path.read_text().splitlines(), 1)
                if named.search(text)
                for test in self.by_line.get(f'{path}:{line}', ())
            }
        cases: Counter[str] = Counter()
        order: dict[str, int] = {}
        for test in sorted(ran, key=self.sizes.__getitem__):
            function, _, _ = test.partition('[')
            order[test] = cases[function]
            cases[function] += 1
        return sorted(order, key=order.__getitem__)[:MOST_TESTS]


@dataclass(frozen=True)
class Mutant:
    """A changed token; line and column, both from one, are where it begins."""

    path: Path
    line: int
    column: int
    token: str

    def __str__(self) -> str:
        return f'{self.path}:{self.line}:{self.column} {self.token}'

    def text(self) -> str:
        """The source of its file with the token changed."""
        lines = self.path.read_text().splitlines(keepends=True)
        line, start = lines[self.line - 1], self.column - 1
        other = OTHERS.get(self.token, f'({self.token} + 1)')
        lines[self.line - 1] = f'{line[:start]}{other}{line[start + len(self.token) :]}'
        return ''.join(lines)


def main() -> None:
    """Draw mutants, try them, and print how many are killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folders', nargs='*', type=Path, default=[Path(one) for one in FOLDERS])
    parser.add_argument('-o', '--output', type=Path, default=Path('mutants.jsonl'))
    parser.add_argument('--count', type=int, default=300)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--contexts', type=Path, help='coverage data of an earlier run')
    given = parser.parse_args()
    paths = sorted(path for folder in given.folders for path in folder.rglob('*.py'))
    mutants = [mutant for path in paths for mutant in mutants_of(path)]
    random.Random(given.seed).shuffle(mutants)
    drawn = list(islice(filter(_compiles, mutants), given.count))
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        copies: Queue[Path] = Queue()
        for k in range(os.cpu_count() or 1):
            copies.put(_copy(Path(folder, str(k))))
        tests = _tests(given.contexts or _contexts(copies.queue[0]))
        lines = given.output.read_text().splitlines() if given.output.exists() else []
        killed_by = {row['mutant']: row['killed_by'] for row in map(json.loads, lines)}
        todo = [mutant for mutant in drawn if str(mutant) not in killed_by]
        for job in as_completed(pool.submit(_try, one, tests, copies) for one in todo):
            mutant, killer = job.result()
            killed_by[str(mutant)] = killer
            print(f'{mutant}: {killer or "SURVIVES"}', flush=True)
            with given.output.open('a') as file:
                print(json.dumps({'mutant': str(mutant), 'killed_by': killer}), file=file)
    print(sum(killed_by[str(one)] != '' for one in drawn), 'of', len(drawn), 'are killed')


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Yield the mutants of a file; heads of functions, annotations and imports stay."""
    text = path.read_text()
    fixed = {line for node in ast.walk(ast.parse(text)) for line in _fixed_lines(node)}
    for one in tokenize.generate_tokens(io.StringIO(text).readline):
        if (one.string in OTHERS or one.type == tokenize.NUMBER) and one.start[0] not in fixed:
            yield Mutant(path, one.start[0], one.start[1] + 1, one.string)


def _fixed_lines(node: ast.AST) -> range:
    """Lines of a node that compute nothing."""
    if isinstance(node, ast.FunctionDef):
        return range(node.lineno, node.body[0].lineno)
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        return range(node.lineno, (node.end_lineno or node.lineno) + 1)
    if isinstance(node, ast.AnnAssign):
        return range(node.lineno, (node.annotation.end_lineno or node.lineno) + 1)
    return range(0)


def _compiles(mutant: Mutant) -> bool:
    try:
        compile(mutant.text(), mutant.path, 'exec')
    except SyntaxError:
        return False
    return True


def _copy(folder: Path) -> Path:
    subprocess.run(['git', 'clone', '--quiet', '--shared', '.', folder], check=True)
    return folder


def _contexts(copy: Path) -> Path:
    """Coverage of the fast tests, with the test that ran each line."""
    data = copy / '.coverage'
    marks = ['-m', 'not nodes and not slow and not packaging']
    workers = ['--numprocesses', 'auto', '--dist', 'loadfile', '--quiet']
    measure = ['--cov=starcal_ros', '--cov-context=test', '--cov-report=']
    _pytest(copy, *marks, *workers, *measure, timeout_s=None)
    return data


def _tests(contexts: Path) -> Tests:
    """Return the tests of coverage data with a context for each test."""
    data = coverage.CoverageData(str(contexts))
    data.read()
    by_line: dict[str, set[str]] = {}
    sizes: dict[str, int] = {}
    for measured in data.measured_files():
        _, package, path = measured.rpartition('starcal_ros/')
        for line, names in data.contexts_by_lineno(measured).items() if package else ():
            ran = {name.rpartition('|')[0] for name in names if name}
            by_line[f'{package}{path}:{line}'] = ran
            for test in ran:
                sizes[test] = sizes.get(test, 0) + 1
    return Tests(by_line, sizes)


def _bound_by(mutant: Mutant) -> str:
    """Names, with bars between them, that the innermost statement around a mutant binds."""
    names: list[str] = []
    for node in ast.walk(ast.parse(mutant.path.read_text())):
        if isinstance(node, (ast.Assign, ast.AnnAssign, ast.ClassDef, ast.FunctionDef)):
            first = min(one.lineno for one in (node, *getattr(node, 'decorator_list', ())))
            if first <= mutant.line <= (node.end_lineno or 0):
                stores = (one for one in ast.walk(node) if isinstance(one, ast.Name))
                bound = [one.id for one in stores if isinstance(one.ctx, ast.Store)]
                names = [node.name] if hasattr(node, 'name') else bound
    return '|'.join(names)


def _try(mutant: Mutant, tests: Tests, copies: Queue[Path]) -> tuple[Mutant, str]:
    """Return the mutant and the test that kills it, empty if none does."""
    copy = copies.get()
    try:
        names = tests.of(mutant) or list(map(str, nearest_tests([mutant.path])))
        (copy / 'tests.txt').write_text('\n'.join(names))
        before = (copy / mutant.path).read_text()
        (copy / mutant.path).write_text(mutant.text())
        printed = _pytest(copy, '-x', '-q', '-p', 'no:cacheprovider', '@tests.txt')
        (copy / mutant.path).write_text(before)
    finally:
        copies.put(copy)
    return mutant, printed


def _pytest(copy: Path, *arguments: str, timeout_s: float | None = TIMEOUT_S) -> str:
    """Return the first test that failed, empty if none did."""
    command = [sys.executable, '-m', 'pytest', *arguments]
    environment = {**os.environ, 'PYTHONPATH': str(copy), 'OPENBLAS_NUM_THREADS': '1'}
    try:
        run = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=timeout_s
        )
    except subprocess.TimeoutExpired:
        return 'it does not end'
    if run.returncode == 0:
        return ''
    # Code that the tests import at their head ends pytest before a test, with words on stderr.
    said = [*run.stdout.splitlines(), *run.stderr.splitlines(), f'status {run.returncode}']
    failed = next((line for line in said if line.startswith(('FAILED', 'ERROR'))), said[-2])
    if failed.startswith('ERROR: not found'):
        raise ValueError(f'{failed}: the contexts are of other tests')
    return failed


if __name__ == '__main__':
    main()
