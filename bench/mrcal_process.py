# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
mrcal on identified stars: ``/usr/bin/python3 mrcal_process.py INPUT OUTPUT``, of ``.npz`` files.

Debian's mrcal needs the system's Python, which has no starcal.  mrcal has no points at infinity:
each star is two fixed points, one behind the other, because with one the place of a camera would
be as good as its rotation or focal length.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

SPLINED = 'SPLINED_STEREOGRAPHIC_order=3'
MODELS = (
    'OPENCV5',
    'OPENCV12',
    f'{SPLINED}_Nx=6_Ny=5_fov_x_deg=22',
    f'{SPLINED}_Nx=8_Ny=7_fov_x_deg=21',
    f'{SPLINED}_Nx=10_Ny=8_fov_x_deg=21',
)
_DEPTHS = (1.0, 10.0)


def _solve(given: Any, model: str) -> tuple[Any, float]:
    """Lines of sight (n, 3) by a LENSMODEL, and the processor time of its search."""
    import mrcal

    splined = model.startswith(SPLINED)
    lens = f'LENSMODEL_{model}'
    distortion = np.zeros(mrcal.lensmodel_num_params(lens) - 4)
    if not splined:
        distortion[:5] = given['distortion']
    n, m = len(given['image']), len(given['rotvec'])
    weight = given['sigma_px'].mean() / given['sigma_px']
    indices = np.column_stack([np.arange(2 * n), np.zeros(2 * n), np.tile(given['image'], 2)])
    problem = {
        'lensmodel': lens,
        'intrinsics': np.concatenate([given['core'], distortion])[None],
        'extrinsics_rt_fromref': np.column_stack([given['rotvec'], np.zeros((m, 3))]),
        # No boards.
        **dict.fromkeys(('frames_rt_toref', 'observations_board')),
        'indices_frame_camintrinsics_camextrinsics': None,
        'points': np.concatenate([depth * given['direction'] for depth in _DEPTHS]),
        'Npoints_fixed': 2 * n,
        'observations_point': np.tile(np.column_stack([given['measured_px'], weight]), (2, 1)),
        'indices_point_camintrinsics_camextrinsics': indices.astype(np.int32),
        'imagersizes': given['size'][None].astype(np.int32),
        'point_min_range': 0.1,
        'point_max_range': 100.0,
        'do_optimize_intrinsics_core': not splined,  # as its manual recommends
        'do_apply_outlier_rejection': False,  # it has one for boards only
    }
    start_s = time.process_time()
    mrcal.optimize(**problem)
    took_s = time.process_time() - start_s
    return mrcal.unproject(given['pixels'], lens, problem['intrinsics'][0]), took_s


def _main() -> None:
    with np.load(sys.argv[1]) as table:
        given = dict(table)
    found = [_solve(given, model) for model in MODELS]
    np.savez(
        sys.argv[2],
        directions=[directions for directions, _ in found],
        processor_s=[took_s for _, took_s in found],
    )


if __name__ == '__main__':
    _main()
