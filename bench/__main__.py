# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""``python -m bench [NAME...]``: run benches and print their tables."""

from __future__ import annotations

import argparse
import importlib
import json
import os
from pathlib import Path
import platform
import sys
import time

from bench import LONG, NAMES


def main() -> None:
    """Run the requested benches; `bench.evidence` has arguments of its own."""
    if sys.argv[1:2] == ['evidence']:
        sys.exit(importlib.import_module('bench.evidence').main(sys.argv[2:]))
    parser = argparse.ArgumentParser(prog='python -m bench', description='Measure starcal.')
    parser.add_argument('names', nargs='*', metavar='NAME', help=', '.join(NAMES + LONG))
    parser.add_argument('--quick', action='store_true', help='small sizes, a few seconds each')
    parser.add_argument(
        '--json', type=Path, metavar='FILE', help='also write the tables to this file'
    )
    args = parser.parse_args()
    for name in args.names:
        if name not in NAMES + LONG:
            parser.error(f'{name!r} is not one of {", ".join(NAMES + LONG)}')
    if 'evidence' in args.names:
        parser.error('evidence is run alone: python -m bench evidence --help')
    load = os.getloadavg()[0]
    print(
        f'{platform.machine()}, {os.cpu_count()} cores, load {load:.1f}: times on a busy machine'
    )
    print('are too long; ratios are of alternating runs.\n')
    found: dict[str, list[dict[str, object]]] = {}
    for name in args.names or NAMES:
        start_s = time.perf_counter()
        found[name] = []
        for table in importlib.import_module(f'bench.{name}').run(args.quick):
            print(table.text(), flush=True)
            found[name].append(table.content())
        print(f'({name}: {time.perf_counter() - start_s:.0f} s)\n', flush=True)
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + '\n')


if __name__ == '__main__':
    main()
