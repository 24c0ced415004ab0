# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Make a deeper star catalog from a table of stars.

For narrow fields: adds the stars of a table to the bundled catalog, which ends at V = 9. The table
covers the sky of the images: Gaia, Tycho-2 or 2MASS as the Gaia archive or VizieR give them, or an
index file of astrometry.net.

  # stars of one field, from the Gaia archive
  starcal catalog gaia.vot -o deep.npz
"""

import argparse
from pathlib import Path
import time

from starcal_ground.cli import arguments, terminal


def add_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    what = 'table of Gaia, Tycho-2 or 2MASS, VOTable, FITS or CSV; or an index file'
    add('table', type=arguments.path, metavar='TABLE', help=what)
    what = 'catalog file to write (.npz), for the option catalog'
    arguments.add_output(command, 'FILE', what, required=True)


def run(args: argparse.Namespace) -> int:
    import numpy as np

    from starcal_ground.mission.ingest.deep_catalog import refusals, UNMOVED, write_deep_catalog
    from starcal_ground.products import check_outputs
    from starcal_ros.constants import ARCSECOND_RAD
    from starcal_ros.sky.astrometry import julian_year
    from starcal_ros.sky.catalog import load_catalog

    output = args.output if args.output.suffix == '.npz' else Path(f'{args.output}.npz')
    check_outputs([output], [args.table])
    made = write_deep_catalog(args.table, output)
    terminal.print_text(
        f'{made.added} stars of {args.table} ({made.source}) to V = {made.faintest:.1f}, with the'
        f' bundled ones {len(made.columns["id"])}, written to {output}'
    )
    if made.refused:
        terminal.print_text(refusals(made.refused))
    checked = f'{made.checked} are where' if made.checked else 'none is near where'
    terminal.print_text(f'{checked} the bundled catalog has them')
    if made.unmoved:
        jyear, catalog = julian_year(time.time_ns()), load_catalog(output)
        unmoved = np.flatnonzero(np.isin(catalog.motion_source, UNMOVED))
        sigma_arcsec = np.median(catalog.place_sigma_rad(unmoved, jyear)) / ARCSECOND_RAD
        terminal.print_text(
            f'{made.unmoved} stars have no proper motion: in {jyear:.0f} their places have a'
            f' 1-sigma of {sigma_arcsec:.2f}", which calibrations include'
        )
    terminal.print_text(
        f'in the parameter file: catalog: {output.absolute()}, magnitude_limit:'
        f' {made.faintest:.1f}'
    )
    return arguments.EXIT_ACCEPTED
