# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tables and page of `bench.evidence`, of one results file or of two beside each other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import json
import math
from pathlib import Path
import re
from typing import Any

import jinja2
import numpy as np
from scipy.special import erf

from bench.table import Table
from starcal_ground.report import page, svg
from starcal_ros.arrays import Floats
from starcal_ros.formats.products.product_files import write_atomically
from studies.trials import rms

Rows = list[dict[str, Any]]

LIES = 2.0  # error over sigma
MARKS = re.compile('(<!-- evidence -->\n).*(<!-- end -->)', re.DOTALL)
# Error over bound before the estimator became a cascade: rms of bags of each kind.
MOST_OVER_BOUND = {'small': 1.16, 'slew': 1.01, 'hostile': 1.30, 'paper': 1.24}


def rows_of(path: Path, digest: str = '') -> Rows:
    """Rows of a results file of sources with a digest, by default those of the last row."""
    lines = path.read_text().splitlines() if path.is_file() else []
    rows = [json.loads(line) for line in lines if line.endswith('}')]  # a stopped run cuts a line
    wanted = digest or (rows[-1]['digest'] if rows else '')
    return list({row['job']: row for row in rows if row['digest'] == wanted}.values())


def tables(after: Rows, before: Rows) -> list[Table]:
    """All tables; a cell is ``before → after`` where the two differ."""
    made = [[make(rows) for make in TABLES] for rows in ((after, before) if before else (after,))]
    if not before:
        return made[0]
    return [_beside(*two) for two in zip(*made, strict=True)]


def _beside(after: Table, before: Table) -> Table:
    """One table of two; rows are matched by their first cell."""
    old = {row[0]: row for row in before.rows}
    both = Table(after.title, after.columns, notes=after.notes)
    for row in after.rows:
        was = old.pop(row[0], (row[0], *['-'] * (len(row) - 1)))
        cells = [_text(cell) for cell in row]
        pairs = zip(map(_text, was), cells, strict=True)
        both.add(*(one if one == two else f'{one} → {two}' for one, two in pairs))
    for row in old.values():
        both.add(row[0], *(f'{_text(cell)} → -' for cell in row[1:]))
    return both


def _text(cell: object) -> str:
    return '-' if cell is None else f'{cell:.2f}' if isinstance(cell, float) else str(cell)


def requirements(rows: Rows) -> Table:
    """Each requirement, its limit and whether it is met."""
    table = Table('Requirements', ('requirement', 'limit', 'found', 'met'))

    def add(name: str, limit: str, found: float, least: float, most: float) -> None:
        met = None if math.isnan(found) else 'yes' if least <= found <= most else 'NO'
        table.add(name, limit, None if math.isnan(found) else found, met)

    for group in ('sound', 'departing'):
        of_group = accepted(rows, group)
        add(f'{group} missions: map, rms', '0.85 to 1.1', rms(shape(of_group)), 0.85, 1.1)
    of_missions = accepted(rows, 'sound', 'departing')
    for name in ('shape', 'pointing'):
        over = sum(row[name] > 3 for row in of_missions) if of_missions else math.nan
        add(f'missions over 3 sigma: {name}', '0', float(over), 0, 0)
    add('sound missions: sigma / bound, median', '1.05',
        _median(over_bound(accepted(rows, 'sound'), 'sigma_arcsec')), 0, 1.05)  # fmt: skip
    sound = _of(rows, 'sound')
    wrongly = 100 * sum(map(is_wrongly_refused, sound)) / len(sound) if sound else math.nan
    add('sound missions refused though right, %', '1', wrongly, 0, 1)
    for kind in ('unknown', 'two samples'):
        turning = shape(
            [row for row in accepted(rows, 'rendered') if f'turning, {kind}' in row['kind']]
        )
        add(f'turning, {kind}: map, rms', '1.2', rms(turning), 0, 1.2)
        add(f'turning, {kind}: map, worst', '2.5', max(turning, default=math.nan), 0, 2.5)
    for group in ('bodies', 'real'):
        of_group = _of(rows, group)
        refused = sum(not row['accepted'] for row in of_group) if of_group else math.nan
        add(f'{group}: refused', '0', float(refused), 0, 0)
    for kind, limit in MOST_OVER_BOUND.items():
        of_kind = [row for row in accepted(rows, 'bags') if row['kind'].startswith(f'bags {kind}')]
        add(f'{kind}: error / bound, rms', f'{limit:g}',
            rms(over_bound(of_kind, 'shape_arcsec')), 0, limit)  # fmt: skip
    ratios = [
        ratio
        for row in _of(rows, 'real')
        for k, (*_, ratio) in row.get('ratios', {}).items()
        if k != 'fit'
    ]
    add(
        'real sets: difference of halves / sigma, worst',
        '1.5',
        max(ratios, default=math.nan),
        0,
        1.5,
    )
    for end, name in (('iteration_limit', 'ended by the limit of rounds'), ('failed', 'failed')):
        add(
            f'campaigns that {name}',
            '0',
            float(sum(row['termination'] == end for row in rows)),
            0,
            0,
        )
    return table


def summary(rows: Rows) -> Table:
    """One row for the missions of each kind and for each world."""
    columns = (
        'campaigns, accepted, refused though right, map rms, worst, centre rms, corners rms,'
        ' pointing rms, worst pointing, sigma / bound, error / bound, iterations, most, cpu s'
    )
    table = Table(
        'Error over reported sigma of accepted campaigns', ['kind', *columns.split(', ')]
    )
    for kind, of_kind in _kinds(row for row in rows if row['group'] != 'real'):
        good = accepted(of_kind)
        pointing = [row['pointing'] for row in good]
        rounds = [row['iterations'] for row in of_kind if row['iterations']]
        table.add(
            *(kind, len(of_kind), len(good), sum(map(is_wrongly_refused, of_kind))),
            *(_with_error(shape(good)), max(shape(good), default=math.nan)),
            *(rms(z_of(good, zone)) for zone in ('centre', 'corners')),
            *(rms(pointing), max(pointing, default=math.nan)),
            _median(over_bound(good, 'sigma_arcsec')),
            rms(over_bound(good, 'shape_arcsec')),
            *(_median(rounds), max(rounds, default=0)),
            _median([row['cpu_s'] for row in of_kind]),
        )
    return table


def coverage(rows: Rows) -> Table:
    """Share of errors within 1, 2 and 3 sigma, in percent, beside the normal law."""
    columns = (
        'errors of single angles',
        'number',
        'rms',
        'within 1',
        'within 2',
        'within 3',
        'worst',
    )
    table = Table('Coverage of random missions, percent', columns)
    table.add(
        'normal law', None, 1.0, *(100 * float(erf(k / math.sqrt(2))) for k in (1, 2, 3)), None
    )
    for group in ('sound', 'departing'):
        for zone in ('centre', 'corners', 'pointing'):
            z = z_of(accepted(rows, group), zone)
            within = [100 * float(np.mean(z <= k)) if len(z) else math.nan for k in (1, 2, 3)]
            worst = float(z.max()) if len(z) else math.nan
            table.add(f'{group}, {zone}', len(z), rms(z), *within, worst)
    return table


def departures(rows: Rows) -> Table:
    """Errors of the missions that have each departure from the model."""
    columns = ('departure', 'accepted', 'map rms', 'worst', 'pointing rms', 'worst pointing')
    table = Table('Random missions by what departs from the model; most have several', columns)
    good = accepted(rows, 'departing')
    for name in sorted({name for row in good for name in row['departures']}):
        of_name = [row for row in good if name in row['departures']]
        pointing = [row['pointing'] for row in of_name]
        table.add(
            *(name, len(of_name), _with_error(shape(of_name)), max(shape(of_name))),
            *(rms(pointing), max(pointing)),
        )
    return table


def real_sets(rows: Rows) -> Table:
    """Difference of halves of real sets, and of the whole from an independent fit, over sigma."""
    columns = (
        'set',
        'images',
        'accepted',
        '1-sigma arcsec',
        'by turns',
        'by time',
        'from the fit',
    )
    table = Table('Real images: difference over its sigma', (*columns, 'iterations'))
    for row in _of(rows, 'real'):
        ratios = [row.get('ratios', {}).get(k, [math.nan])[-1] for k in ('turns', 'time', 'fit')]
        table.add(
            *(
                row['kind'].removeprefix('real '),
                row.get('images'),
                'yes' if row['accepted'] else 'NO',
            ),
            *(row['sigma_arcsec'], *ratios, row['iterations']),
        )
    return table


def lies(rows: Rows) -> Table:
    """Each accepted campaign with an error over two sigma."""
    columns = ('campaign', 'map', 'pointing', 'error arcsec', 'sigma arcsec')
    table = Table(f'Accepted with an error over {LIES:g} sigma', columns)
    for row in sorted(accepted(rows), key=lambda row: -max(row['shape'], row['pointing'])):
        if max(row['shape'], row['pointing']) > LIES:
            table.add(
                *(row[k] for k in ('job', 'shape', 'pointing', 'shape_arcsec', 'sigma_arcsec'))
            )
    return table


def refusals(rows: Rows) -> Table:
    """Each refused campaign with its error and all reasons."""
    table = Table('Refused', ('campaign', 'map', 'pointing', 'reasons'))
    for row in rows:
        if not row['accepted']:
            table.add(row['job'], row['shape'], row['pointing'], ' | '.join(row['reasons'])[:300])
    return table


TABLES: tuple[Callable[[Rows], Table], ...] = (
    *(requirements, summary, coverage, departures, real_sets, lies, refusals),
)


def accepted(rows: Rows, *groups: str) -> Rows:
    """Accepted campaigns of groups whose truth is known."""
    return [r for r in _of(rows, *groups) if r['accepted'] and math.isfinite(r['shape'])]


def _of(rows: Rows, *groups: str) -> Rows:
    return [row for row in rows if row['group'] in groups or not groups]


def _kinds(rows: Iterable[dict[str, Any]]) -> list[tuple[str, Rows]]:
    kinds: dict[str, Rows] = {}
    for row in rows:
        kinds.setdefault(row['kind'], []).append(row)
    return sorted(kinds.items())


def shape(rows: Rows) -> list[float]:
    """Errors of the map over their sigma."""
    return [row['shape'] for row in rows]


def over_bound(rows: Rows, name: str) -> list[float]:
    """Errors or sigmas over their Cramer-Rao bound, where there is one."""
    return [row[name] / row['bound_arcsec'] for row in rows if row['bound_arcsec'] > 0]


def z_of(rows: Rows, zone: str) -> Floats:
    """Errors of single angles of a zone over their sigma, without their signs."""
    return np.asarray(np.abs(np.concatenate([row['z'][zone] for row in rows] or [[]])))


def is_wrongly_refused(row: dict[str, Any]) -> bool:
    """True where the errors are within 2 sigma, and the sigma is not too large for its use."""
    is_right = not row['accepted'] and max(row['shape'], row['pointing']) < LIES
    return is_right and not any('1-sigma of' in reason for reason in row['reasons'])


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _with_error(ratios: Sequence[float]) -> str:
    """Rms of ratios with its counting error."""
    if len(ratios) < 2:
        return _text(rms(ratios))
    error = float(np.std(np.square(ratios), ddof=1)) / math.sqrt(len(ratios)) / (2 * rms(ratios))
    return f'{rms(ratios):.2f} ± {error:.2f}'


def charts(after: Rows, before: Rows) -> list[svg.Chart]:
    """Share of errors beyond k sigma in each zone, beside the normal law."""
    k = np.linspace(0.0, 5.0, 101)
    made = []
    for zone in ('centre', 'corners', 'pointing'):
        curves = [
            svg.Curve(
                k, np.maximum(1 - erf(k / math.sqrt(2)), 1e-6), name='normal law', dash='4 3'
            )
        ]
        for name, rows, dash in (('', after, ''), (' before', before, '2 2')):
            for colour, group in zip(svg.SERIES, ('sound', 'departing'), strict=False):
                z = z_of(accepted(rows, group), zone)
                if len(z):
                    beyond = 1 - np.searchsorted(np.sort(z), k) / len(z)
                    beyond = np.where(beyond > 0, beyond, np.nan)
                    curves.append(svg.Curve(k, beyond, colour, group + name, dash=dash))
        drawing = svg.plot(curves, 'k, sigma', 'share beyond', log='y', y=(1e-4, 1.0))
        text = (
            'Share of errors of single angles beyond k times the reported sigma, random missions.'
        )
        made.append(svg.Chart(zone.capitalize(), drawing, text))
    return made


def write(made: Sequence[Table], after: Rows, before: Rows, path: Path) -> None:
    """Write the page."""
    folders = [Path(__file__).parent, Path(page.__file__).parent / 'templates']
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders), autoescape=True, trim_blocks=True
    )
    shown = [(table, [[_text(cell) for cell in row] for row in table.rows]) for table in made]
    digests = [rows[-1]['digest'] for rows in (before, after) if rows]
    template = environment.get_template('evidence.html')
    content = {'tables': shown, 'charts': charts(after, before), 'digests': digests}
    write_atomically(path, template.render(**content, count=len(after)))


def write_document(made: Sequence[Table], path: Path) -> None:
    """Replace the tables of a Markdown document; refusals are in the page alone."""
    parts = []
    for table in made[:-1]:
        lines = [table.columns, ['---'] * len(table.columns), *table.rows]
        text = '\n'.join(f'| {" | ".join(map(_text, line))} |' for line in lines)
        parts.append(f'**{table.title}**\n\n{text}\n\n')
    before = path.read_text()
    path.write_text(MARKS.sub(lambda found: found[1] + ''.join(parts) + found[2], before))
