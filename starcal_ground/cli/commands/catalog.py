# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Make a deeper star catalog from a table of Gaia.

For narrow fields: adds the stars of a table of Gaia DR3 to the bundled catalog, which ends at V =
9. The table covers the sky of the images, with the columns source_id, ra, dec, pmra, pmdec,
parallax, phot_g_mean_mag and bp_rp, or their VizieR names.

  # stars of one field, from the Gaia archive
  starcal catalog gaia.vot -o deep.npz
"""

import argparse
from pathlib import Path

from starcal_ground.cli import arguments, terminal


def add_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    what = 'table of Gaia DR3 by the Gaia archive or VizieR: VOTable, FITS, CSV or Parquet'
    add('table', type=arguments.path, metavar='GAIA_FILE', help=what)
    what = 'catalog file to write (.npz), for the option catalog'
    arguments.add_output(command, 'FILE', what, required=True)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.mission.ingest.gaia_catalog import refusals, write_deep_catalog
    from starcal_ground.outputs import check_outputs

    output = args.output if args.output.suffix == '.npz' else Path(f'{args.output}.npz')
    check_outputs([output], [args.table])
    made = write_deep_catalog(args.table, output)
    terminal.print_text(
        f'{made.added} stars of {args.table} to V = {made.faintest:.1f}, with the bundled ones'
        f' {len(made.columns["id"])}, written to {output}'
    )
    if made.refused:
        terminal.print_text(refusals(made.refused))
    if made.unmoved:
        what = 'stars have no proper motion: 0.1" off in ten years is usual'
        terminal.print_text(f'{made.unmoved} {what}')
    terminal.print_text(
        f'in the parameter file: catalog: {output.absolute()}, magnitude_limit:'
        f' {made.faintest:.1f}'
    )
    return arguments.EXIT_ACCEPTED
