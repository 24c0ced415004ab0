# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal calibrate` as a process, from bag to report, against a bare read of the same bag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from bench.table import Table
from bench.trials import memory_mb
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation import simulated_bag

MOST_MB = 300.0
# Scenario, images, most wall time in seconds, and as a multiple of the bare read.
SIZES = (('small', 24, 1.5, None), ('paper', 60, None, 3.0), ('paper', 359, None, 2.0))
_ROUNDS = 4

# Reads every message as the package's own documentation does.
_BARE = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], 'rb') as stream:
    print(sum(len(message.data) for _, _, message in make_reader(stream).iter_messages()))
"""

# The start-up file of the ROS wheels restarts Python from a shell; an installed package has its
# bytecode: to compile this one takes a quarter of a second.
_NOT_OF_A_SHELL = ('_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'PYTHONDONTWRITEBYTECODE')

# As the console script does.
TOOL = 'import sys; from starcal_ground.cli.entry_point import main; sys.exit(main())'


class Cost(NamedTuple):
    """Wall time, processor time (user and system, of the process and its children), memory."""

    wall_s: float
    processor_s: float
    peak_mb: float


def run(quick: bool) -> Iterator[Table]:
    """Compare bags of several sizes with a bare read."""
    rounds = 1 if quick else _ROUNDS
    for name, images, most_s, most_ratio in (('tiny', 10, None, None),) if quick else SIZES:
        yield compare(name, images, most_s, most_ratio, rounds)


def compare(
    name: str, images: int, most_s: float | None, most_ratio: float | None, rounds: int
) -> Table:
    """Alternate a bare read and a calibration of a rendered bag."""
    print(f'calibrate: rendering {images} images of scenario {name}', flush=True)
    with tempfile.TemporaryDirectory() as folder:
        scenario = dataclasses.replace(synthetic.scenario(name), image_count=images)
        made = simulated_bag.write_bag(scenario, Path(folder, 'bag'))
        (file,) = made.bag.glob('*.mcap')
        calibrate = ['calibrate', str(made.bag), '--params']
        calibrate += [str(made.params), '-o', str(Path(folder, 'out'))]
        costs: dict[str, list[Cost]] = {'bare read with mcap': [], 'starcal calibrate': []}
        calls = (['-c', _BARE, str(file)], ['-c', TOOL, *calibrate])
        for _ in range(rounds):
            for runs, arguments in zip(costs.values(), calls, strict=True):
                runs.append(cost(arguments))
    size = f'{scenario.truth.camera.width} x {scenario.truth.camera.height}'
    return _compared(f'{images} images of {size}', costs, most_s, most_ratio)


def _compared(
    title: str, costs: dict[str, list[Cost]], most_s: float | None, most_ratio: float | None
) -> Table:
    """Least and median of the runs, and the median ratio of the pairs."""
    bare, whole = costs.values()
    table = Table(
        f'{title}, bag to report; {len(bare)} pairs of runs',
        ('', 'wall s', 'least', 'processor s', 'least ', 'peak MB'),
    )
    for name, runs in costs.items():
        wall_s, processor_s, peak_mb = zip(*runs, strict=True)
        table.add(
            *(name, statistics.median(wall_s), min(wall_s)),
            *(statistics.median(processor_s), min(processor_s), max(peak_mb)),
        )
    # Of wall and of processor times.
    ratios = [[b[k] / a[k] for a, b in zip(bare, whole, strict=True)] for k in range(2)]
    cells = [cell for ratio in ratios for cell in (statistics.median(ratio), min(ratio))]
    table.add('ratio of a pair', *cells, None)
    if most_s is not None:
        table.notes.append(_verdict('wall time', min(r.wall_s for r in whole), most_s, 's'))
    if most_ratio is not None:
        table.notes.append(_verdict('ratio of wall times', min(ratios[0]), most_ratio, ''))
    table.notes.append(_verdict('memory', max(r.peak_mb for r in whole), MOST_MB, 'MB'))
    return table


def _verdict(what: str, found: float, most: float, unit: str) -> str:
    met = 'met' if found <= most else 'MISSED'
    return f'{what}: {found:.3g} of at most {most:g} {unit}'.rstrip() + f': {met}'


def cost(arguments: Sequence[str]) -> Cost:
    """Cost of a Python process with some arguments."""
    kept = {k: v for k, v in os.environ.items() if k not in _NOT_OF_A_SHELL}
    start_s = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=kept)
    peak_mb = 0.0
    while True:
        # The ru_maxrss of a child includes the memory of its parent at the start: ask the kernel.
        peak_mb = max(peak_mb, memory_mb(process.pid, 'VmHWM'))
        done, code, usage = os.wait4(process.pid, os.WNOHANG)
        if done:
            break
        time.sleep(0.01)
    wall_s = time.perf_counter() - start_s
    process.returncode = os.waitstatus_to_exitcode(code)
    if process.returncode not in (0, 3):
        raise RuntimeError(f'{" ".join(arguments[:3])} ended with {process.returncode}')
    return Cost(wall_s, usage.ru_utime + usage.ru_stime, peak_mb)
