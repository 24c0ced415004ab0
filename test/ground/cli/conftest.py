# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Inputs and products of a campaign, for commands that read and write them."""

from collections.abc import Callable
from pathlib import Path
import shutil

from attacks import write_product_folder  # type: ignore[import-not-found]
from mission_files import write_frames, write_lsk, write_sclk  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ros.sky.catalog import load_catalog


@pytest.fixture(scope='session')
def campaign(made_once: Callable[..., Path], few_images: Path) -> Path:
    """Bag, products in ``out/``, frames, kernels, Gaia stars, pointings; tests change nothing."""

    def write(folder: Path) -> None:
        shutil.copytree(few_images, folder / 'bag')
        write_product_folder(folder / 'out')
        write_frames(folder / 'frames')
        write_lsk(folder / 'naif.tls')
        write_sclk(folder / 'clock.tsc')
        stars = load_catalog(None, 3.0)
        stars = stars.select(stars.id > 0)
        places = np.degrees([stars.ra_rad, stars.dec_rad])
        columns = zip(stars.id, *places, stars.magnitude, strict=True)
        rows = [','.join(map(str, row)) for row in columns]
        header = 'source_id,ra,dec,phot_g_mean_mag'
        (folder / 'gaia.csv').write_text('\n'.join([header, *rows, '']))
        (folder / 'places.csv').write_text('ra_deg,dec_deg\n1,2\n')

    return made_once('campaign', write)
