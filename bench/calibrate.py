# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal calibrate` as a process, from bag to products."""

from __future__ import annotations

import os
from pathlib import Path
import pstats
import statistics
import subprocess
import sys
import tempfile
import time

from bench.table import Table
from starcal_ros.simulation import bag as simulated_bag
from starcal_ros.simulation import scenario as synthetic

TARGET_S = 6.0
# Cumulative times; indented stages are parts of the one above.
_STAGES = (
    ('import of Python modules', 'importlib._bootstrap', '_find_and_load'),
    ('load options, camera, catalog', 'pipeline/setup', 'load_setup'),
    ('read images from the bag', 'bag/reader', 'read_images'),
    ('measure and identify stars', 'pipeline/observe', 'observe_next'),
    ('  background', 'image/detection', 'measure_background'),
    ('  prediction', 'identification/prediction', 'predict'),
    ('  match', 'identification/star_finder', '_find'),
    ('  PSF and pixel noise', 'image/image_model', 'model_image'),
    ('  images after the first', 'identification/tracking', 'track_stars'),
    ('  centroids', 'image/centroiding', 'measure_stars'),
    ('estimate', 'estimation/calibrate', 'estimate_calibration'),
    ('digest of the observations', 'pipeline/provenance', '_digest'),
)


def run(quick: bool) -> list[Table]:
    """Time the command, then profile it."""
    name = 'tiny' if quick else 'small'
    print(f'calibrate: rendering scenario {name}', flush=True)
    with tempfile.TemporaryDirectory() as folder:
        scenario = synthetic.scenario(name)
        made = simulated_bag.write_bag(scenario, Path(folder, 'bag'))
        out = Path(folder, 'out')
        command = ['starcal_ros.cli.main', 'calibrate', str(made.bag)]
        command += ['--params', str(made.params), '-o', str(out)]
        wall = time_command(name, scenario.image_count, ['-m', *command], 1 if quick else 3)
        profile = Path(folder, 'profile')
        _run(['-m', 'cProfile', '-o', str(profile), '-m', *command])
        stages = _stages(profile)
    for table in (wall, stages):
        print(table.text())
    return [wall, stages]


def time_command(
    name: str, images: int, command: list[str], repeats: int, target_s: float = TARGET_S
) -> Table:
    """Wall time, processor time and memory of a calibration as a separate process."""
    runs = [_run(command) for _ in range(repeats)]
    wall_s, user_s, system_s, peak_mb = zip(*runs, strict=True)
    met = 'met' if min(wall_s) < target_s else 'MISSED'
    table = Table(
        f'starcal calibrate, scenario {name}, {images} images; {repeats} runs',
        ('', 'least', 'median', 'target'),
    )
    table.add('wall s', min(wall_s), statistics.median(wall_s), f'< {target_s:g}: {met}')
    table.add('user s', min(user_s), statistics.median(user_s), '')
    table.add('system s', min(system_s), statistics.median(system_s), '')
    table.add('peak MB', min(peak_mb), statistics.median(peak_mb), '')
    return table


def _run(arguments: list[str]) -> tuple[float, float, float, float]:
    """Wall, user and system seconds and peak resident MB of Python with some arguments."""
    # As from a shell: the start-up file of the ROS wheels restarts Python.
    kept = {k: v for k, v in os.environ.items() if k != '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
    start_s = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=kept)
    status = Path(f'/proc/{process.pid}/status')
    peak_kb = 0
    while True:
        # The ru_maxrss of a child includes the memory of its parent at the start: ask the kernel.
        for line in status.read_text().splitlines():
            if line.startswith('VmHWM'):
                peak_kb = max(peak_kb, int(line.split()[1]))
        done, code, usage = os.wait4(process.pid, os.WNOHANG)
        if done:
            break
        time.sleep(0.01)
    wall_s = time.perf_counter() - start_s
    process.returncode = os.waitstatus_to_exitcode(code)
    if process.returncode not in (0, 3):
        raise RuntimeError(f'starcal calibrate ended with {process.returncode}')
    return wall_s, usage.ru_utime, usage.ru_stime, peak_kb / 1024


def _stages(profile: Path) -> Table:
    """Share of each stage in a profiled run."""
    stats = pstats.Stats(str(profile))
    found = stats.stats  # type: ignore[attr-defined]
    total_s = stats.total_tt  # type: ignore[attr-defined]
    table = Table('Share of the time by stage, from cProfile', ('stage', 'calls', 's', 'share %'))
    for stage, module, function in _STAGES:
        rows = [
            (calls, cumulative_s)
            for (file, _, name), (_, calls, _, cumulative_s, _) in found.items()
            if name == function and _module(file) == module
        ]
        if not rows:
            raise LookupError(f'{module}.{function} was not called: is the stage still there?')
        for calls, cumulative_s in rows:
            table.add(stage, calls, cumulative_s, 100 * cumulative_s / total_s)
    table.add('all', None, total_s, 100.0)
    return table


def _module(file: str) -> str:
    """Path of a profiled file in the package, without its suffix; or name of a frozen module."""
    stem = file.removeprefix('<frozen ').removesuffix('>').removesuffix('.py')
    return stem.rpartition('starcal_ros/')[2]
