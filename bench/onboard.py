# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The exported C: time of a call, size of the table and stack of a function."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from pathlib import Path
import subprocess
import tempfile

import numpy as np

from bench.table import Table
from starcal_ground.mission.export.c_camera import c_files, c_table
import starcal_ros
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.records import Calibration, factored_field, MapCovariance

_PROGRAM = r"""
#include "starcal_camera.h"
#include <stdio.h>
#include <time.h>
#define TIMED(NAME, CALLS, CALL) do { \
  const clock_t start = clock(); long k; \
  for (k = 0; k < (CALLS); ++k) { pixel[0] = k % 1000; if ((CALL) > STARCAL_OUTSIDE) return 1; } \
  printf(NAME " %g\n", 1e6 * (double)(clock() - start) / CLOCKS_PER_SEC / (CALLS)); } while (0)
int main(void)
{
  starcal_camera camera;
  double pixel[2] = {0, 500}, back[2], d[3] = {0, 0, 1}, three[9], two[4], J[6];
  if (starcal_builtin(&camera) != STARCAL_OK) return 1;
  TIMED("starcal_load", 20L, starcal_builtin(&camera));
  TIMED("starcal_line_of_sight", 20000L, starcal_line_of_sight(&camera, pixel, d, NULL));
  TIMED("starcal_line_of_sight+derivatives", 20000L, starcal_line_of_sight(&camera, pixel, d, J));
  TIMED("starcal_project", 20000L, starcal_project(&camera, d, back, NULL));
  TIMED("starcal_covariance", 200L,
        starcal_covariance(&camera, pixel, STARCAL_POINTING, three, two));
  return 0;
}
"""
_TINY = Path(__file__).parents[1] / 'bags/tiny'
_OCTAVES = 4


def run(quick: bool) -> Iterator[Table]:
    """Compile the C of a calibration without and with a field, and time its functions."""
    made = starcal_ros.calibrate_bag(_TINY, _TINY / 'params.yaml')
    camera = dataclasses.replace(made.geometry.camera, field=None)
    geometry = dataclasses.replace(made.geometry, camera=camera)
    plain = dataclasses.replace(made, geometry=geometry, field=None)
    yield _timed(plain, 'no field')
    yield _timed(_with_field(plain), f'{_OCTAVES} octaves')


def _with_field(plain: Calibration) -> Calibration:
    camera = plain.geometry.camera
    size = camera.width, camera.height
    count = term_count(*size, _OCTAVES)
    joint = 1e-8 * np.eye(len(plain.covariance) + 2 * count)
    joint[: len(plain.covariance), : len(plain.covariance)] = plain.covariance
    field = DetectorField(*size, _OCTAVES, np.full((2, count), 1e-3))
    return dataclasses.replace(plain, field=factored_field(field, MapCovariance(joint)))


def _timed(calibration: Calibration, title: str) -> Table:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in c_files(calibration).items():
            (folder / file).write_text(text)
        (folder / 'main.c').write_text(_PROGRAM)
        command = ['gcc', '-O2', '-std=c99', '-fstack-usage', 'main.c', 'starcal_camera.c']
        subprocess.run([*command, '-o', 'main', '-lm'], cwd=folder, check=True)
        done = subprocess.run([folder / 'main'], capture_output=True, text=True, check=True)
        used = [line.split('\t') for p in folder.glob('*.su') for line in p.open()]
    stack = {place.split(':')[-1]: int(size) for place, size, _ in used}
    table = Table(f'The exported C, {title}', ('function', 'us a call', 'stack of its own, bytes'))
    for function, us in (line.split() for line in done.stdout.splitlines()):
        table.add(function, float(us), stack.get(function.split('+')[0]))
    table.notes.append(f'table of {len(c_table(calibration))} bytes, gcc -O2')
    return table
