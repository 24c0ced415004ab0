# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Tables and page of ``python -m bench evidence``, of one results file or of two beside each other.

``python -m docs.make_evidence RESULTS [--before OLD]`` also writes the tables of docs/evidence.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import contextlib
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
from starcal_ground.written_files import write_marked
from starcal_ros.arrays import Floats
from studies.trials import rms

FILE = Path(__file__).parent / 'evidence.md'
LIES = 2.0  # error over sigma
HALVES = ('turns', 'time')
# Error over bound, rms: that of version 4a3c3ed in four scenes of each kind of another simulator.
MOST_OVER_BOUND = {'small': 1.16, 'slew': 1.01, 'hostile': 1.3, 'paper': 1.24}
TURNING = ('unknown shutter', 'two samples an image')

Rows = list[dict[str, Any]]


def rows_of(path: Path, digest: str = '') -> Rows:
    """Rows of a results file of sources with a digest, by default those of its last row."""
    rows: Rows = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError):  # a run that is killed cuts its last line
            rows.append(json.loads(line))
    digest = digest or (rows[-1]['digest'] if rows else '')
    return list({row['job']: row for row in rows if row['digest'] == digest}.values())


def tables(after: Rows, before: Rows) -> list[Table]:
    """All tables; a cell is ``before → after`` where the two differ."""
    if not before:
        return [make(after) for make in TABLES]
    return [_beside(make(after), make(before)) for make in TABLES]


def _beside(after: Table, before: Table) -> Table:
    """One table of two, whose rows are matched by their first cells."""
    rows = [{row[0]: list(map(_text, row[1:])) for row in one.rows} for one in (before, after)]
    absent = ['-'] * (len(after.columns) - 1)
    both = Table(after.title, after.columns)
    for name in dict.fromkeys([*rows[1], *rows[0]]):
        pairs = zip(*(one.get(name, absent) for one in rows), strict=True)
        both.add(name, *(old if old == new else f'{old} → {new}' for old, new in pairs))
    return both


def _text(cell: object) -> str:
    if isinstance(cell, float):
        return '-' if math.isnan(cell) else f'{cell:.2f}'
    return '-' if cell is None else str(cell)


def requirements(rows: Rows) -> Table:
    """Each requirement with its limits, and whether it is met."""
    table = Table('Requirements', ('requirement', 'limits', 'found', 'met'))
    for name, found, least, most in _required(rows):
        met = '-' if math.isnan(found) else 'yes' if least <= found <= most else 'NO'
        table.add(name, f'{least:g} to {most:g}', float(found), met)
    return table


def _required(rows: Rows) -> Iterator[tuple[str, float, float, float]]:
    """Requirements: name, number found (NaN where there is none), least and most."""
    sound, missions = _of(rows, 'sound'), accepted(rows, 'sound', 'departing')
    for group in ('sound', 'departing'):
        yield f'{group} missions: map, rms', rms(shape(accepted(rows, group))), 0.85, 1.1
    for name in ('shape', 'pointing'):
        yield f'missions beyond 3 sigma: {name}', _count([m[name] > 3 for m in missions]), 0, 0
    over = over_bound(accepted(rows, 'sound'), 'sigma_arcsec')
    yield 'sound missions: sigma / bound, median', _median(over), 0, 1.05
    share = 100 * _count(list(map(is_wrongly_refused, sound))) / max(len(sound), 1)
    yield 'sound missions refused though right, %', share, 0, 1
    for kind in TURNING:
        turning = [row for row in accepted(rows, 'rendered') if f'turning, {kind}' in row['kind']]
        yield f'turning, {kind}: map, rms', rms(shape(turning)), 0, 1.2
        yield f'turning, {kind}: map, worst', max(shape(turning), default=math.nan), 0, 2.5
    for group in ('bodies', 'real'):
        yield f'{group}: refused', _count([not row['accepted'] for row in _of(rows, group)]), 0, 0
    for kind, most in MOST_OVER_BOUND.items():
        good = [row for row in accepted(rows, 'bags') if row['kind'].startswith(f'bags {kind}')]
        yield f'{kind}: error / bound, rms', rms(over_bound(good, 'shape_arcsec')), 0, most
    ratios = [row.get('ratios', {}).get(k, 0.0) for row in _of(rows, 'real') for k in HALVES]
    yield 'halves of real sets: difference / sigma, worst', max(ratios, default=math.nan), 0, 1.5
    for end, name in (('iteration_limit', 'ended by the limit of rounds'), ('failed', 'failed')):
        yield f'campaigns that {name}', _count([end in row['termination'] for row in rows]), 0, 0


def _count(flags: Sequence[bool]) -> float:
    return float(sum(flags)) if flags else math.nan


def summary(rows: Rows) -> Table:
    """One row for the missions of each kind and for each world."""
    columns = (
        'kind, campaigns, accepted, refused though right, map rms, worst, centre rms, corners rms,'
        ' pointing rms, worst pointing, sigma / bound, error / bound, iterations, most, cpu s'
    )
    table = Table('Error over reported sigma of accepted campaigns', columns.split(', '))
    for kind in sorted({row['kind'] for row in rows if row['group'] != 'real'}):
        of_kind = [row for row in rows if row['kind'] == kind]
        good, iterations = accepted(of_kind), [row['iterations'] for row in of_kind]
        table.add(
            *(kind, len(of_kind), len(good), sum(map(is_wrongly_refused, of_kind))),
            *_errors(good),
            *(rms(z_of(good, 'centre')), rms(z_of(good, 'corners')), *_errors(good, 'pointing')),
            *(_median(over_bound(good, 'sigma_arcsec')), rms(over_bound(good, 'shape_arcsec'))),
            *(_median(iterations), max(iterations), _median([row['cpu_s'] for row in of_kind])),
        )
    return table


def coverage(rows: Rows) -> Table:
    """Share of errors within 1, 2 and 3 sigma beside that of the normal law."""
    columns = 'single angles, number, rms, within 1 sigma, within 2, within 3, worst'
    table = Table('Coverage of random missions, %', columns.split(', '))
    table.add('normal law', None, 1.0, *(100 * _normal(k) for k in (1, 2, 3)), None)
    for group in ('sound', 'departing'):
        for zone in ('centre', 'corners', 'pointing'):
            z = z_of(accepted(rows, group), zone)
            if len(z):
                within = [100 * float(np.mean(z <= k)) for k in (1, 2, 3)]
                table.add(f'{group}, {zone}', len(z), rms(z), *within, float(z.max()))
    return table


def departures(rows: Rows) -> Table:
    """Errors of the missions that have each departure from the model."""
    columns = ('departure', 'accepted', 'map rms', 'worst', 'pointing rms', 'worst pointing')
    table = Table('Departing missions by departure; most have several', columns)
    good = accepted(rows, 'departing')
    for name in sorted({name for row in good for name in row['departures']}):
        with_it = [row for row in good if name in row['departures']]
        table.add(name, len(with_it), *_errors(with_it), *_errors(with_it, 'pointing'))
    return table


def real_sets(rows: Rows) -> Table:
    """Difference of halves of real sets, and of the whole from an independent fit, over sigma."""
    columns = 'set, images, all accepted, 1-sigma arcsec, by turns, by time, from a fit'
    table = Table('Real images: difference over its sigma', (*columns.split(', '), 'iterations'))
    for row in _of(rows, 'real'):
        ratios = [row.get('ratios', {}).get(name) for name in (*HALVES, 'fit')]
        is_good = 'yes' if row['accepted'] else 'NO'
        name, images = row['kind'].removeprefix('real '), row.get('images')
        table.add(name, images, is_good, row['sigma_arcsec'], *ratios, row['iterations'])
    return table


def lies(rows: Rows) -> Table:
    """Each accepted campaign with an error beyond two sigma."""
    columns = ('campaign', 'map', 'pointing', 'error arcsec', '1-sigma arcsec')
    table = Table(f'Accepted with an error beyond {LIES:g} sigma', columns)
    for row in sorted(accepted(rows), key=lambda row: -float(max(row['shape'], row['pointing']))):
        if max(row['shape'], row['pointing']) > LIES:
            both = (row['shape_arcsec'], row['sigma_arcsec'])
            table.add(row['job'], row['shape'], row['pointing'], *both)
    return table


def refusals(rows: Rows) -> Table:
    """Each refused campaign with its errors and its reasons."""
    table = Table('Refused', ('campaign', 'map', 'pointing', 'reasons'))
    for row in rows:
        if not row['accepted']:
            table.add(row['job'], row['shape'], row['pointing'], ' | '.join(row['reasons'])[:400])
    return table


TABLES = (requirements, summary, coverage, departures, real_sets, lies, refusals)


def accepted(rows: Rows, *groups: str) -> Rows:
    """Accepted campaigns of groups whose truth is known."""
    return [r for r in _of(rows, *groups) if r['accepted'] and math.isfinite(r['shape'])]


def _of(rows: Rows, *groups: str) -> Rows:
    return [row for row in rows if row['group'] in groups or not groups]


def shape(rows: Rows) -> list[float]:
    """Errors of the map over their sigma."""
    return [row['shape'] for row in rows]


def over_bound(rows: Rows, name: str) -> list[float]:
    """Errors or sigmas over their Cramer-Rao bound, where there is one."""
    return [row[name] / row['bound_arcsec'] for row in rows if row['bound_arcsec'] > 0]


def z_of(rows: Rows, zone: str) -> Floats:
    """Errors of single angles of a zone over their sigma, without their signs."""
    of_rows = [np.array(row['z'][zone]) for row in rows]
    return np.asarray(np.abs(np.concatenate(of_rows or [np.empty(0)])))


def is_wrongly_refused(row: dict[str, Any]) -> bool:
    """True where the errors are within 2 sigma, and no reason is that the sigma is too large."""
    is_right = not row['accepted'] and max(row['shape'], row['pointing']) < LIES
    return is_right and not any('1-sigma of' in reason for reason in row['reasons'])


def _errors(rows: Rows, name: str = 'shape') -> tuple[str | float, float]:
    """Rms of errors over sigma, with its counting error, and the worst."""
    x = np.array([row[name] for row in rows])
    if len(x) < 2:
        return rms(x), max(x.tolist(), default=math.nan)
    counting = float(np.std(x**2, ddof=1)) / math.sqrt(len(x)) / (2 * rms(x))
    return f'{rms(x):.2f} ± {counting:.2f}', float(x.max())


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _normal(k: float) -> float:
    """Share of a normal distribution within k sigma."""
    return float(erf(k / math.sqrt(2)))


def charts(after: Rows, before: Rows) -> list[svg.Chart]:
    """Share of errors beyond k sigma in each zone, beside that of the normal law."""
    k = np.linspace(0.0, 4.0, 81)
    text = 'Share of errors of single angles beyond k times the reported sigma, random missions.'
    made = []
    for zone in ('centre', 'corners', 'pointing'):
        curves = [svg.Curve(k, [1 - _normal(one) for one in k], name='normal law', dash='6 3')]
        for name, rows, dash in (('', after, ''), (' before', before, '2 2')):
            for colour, group in zip(svg.SERIES[:2], ('sound', 'departing'), strict=True):
                z = z_of(accepted(rows, group), zone)
                if len(z):
                    beyond = [float(np.mean(z > one)) or math.nan for one in k]
                    curves.append(svg.Curve(k, beyond, colour, group + name, dash=dash))
        drawing = svg.plot(curves, 'k', 'share beyond', log='y', y=(1e-4, 1.0))
        made.append(svg.Chart(zone.capitalize(), drawing, text))
    return made


def write(path: Path, before: Path | None = None) -> list[Table]:
    """Print the tables of a results file, beside those of another, and write its page."""
    rows = rows_of(path)
    jobs = {row['job'] for row in rows}  # the same campaigns, for a difference with little noise
    old = [row for row in rows_of(before) if row['job'] in jobs] if before else []
    made = tables(rows, old)
    for table in made:
        print(table.text())
    folders = [Path(one).parent / 'templates' for one in (__file__, page.__file__)]
    loader = jinja2.FileSystemLoader(folders)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    shown = [(table, [[_text(cell) for cell in row] for row in table.rows]) for table in made]
    content = {'tables': shown, 'charts': charts(rows, old), 'count': len(rows)}
    digests = [some[-1]['digest'] for some in (old, rows) if some]
    text = environment.get_template('evidence.html').render(**content, digests=digests)
    write_marked(path.with_suffix('.html'), text)
    return made


def main() -> None:
    """Write the tables of a results file into the document; the refusals are in the page alone."""
    parser = argparse.ArgumentParser(description='Write the tables of docs/evidence.md.')
    parser.add_argument('results', type=Path)
    parser.add_argument('--before', type=Path)
    args = parser.parse_args()
    parts = []
    for table in write(args.results, args.before)[:-1]:
        lines = [table.columns, ['---'] * len(table.columns), *table.rows]
        text = '\n'.join(f'| {" | ".join(map(_text, line))} |' for line in lines)
        parts.append(f'**{table.title}**\n\n{text}\n\n')
    marks = re.compile('(<!-- evidence -->\n).*(<!-- end -->)', re.DOTALL)
    before = FILE.read_text()
    FILE.write_text(marks.sub(lambda found: found[1] + ''.join(parts) + found[2], before))


if __name__ == '__main__':
    main()
