# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each argument and option that names a file, given what is no such file: one line, in time."""

from collections.abc import Callable
import os
from pathlib import Path
import resource
import shutil

from attacks import NO_FILES  # type: ignore[import-not-found]
import pytest
from starcal_tool import assert_refused  # type: ignore[import-not-found]

pytestmark = pytest.mark.usefixtures('forked_readers')
_MOST_BYTES = 1 << 30  # that a file adds to the memory


def _unreadable(path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip('root reads every file')
    path.touch(mode=0)


KINDS: dict[str, Callable[[Path], object]] = {
    **NO_FILES,
    'unreadable': _unreadable,
    'empty': Path.touch,
    'garbage': lambda path: path.write_bytes(bytes(range(256)) * 64),
    'other text': lambda path: path.write_text('# of another program\n'),
}
_IMPORT = (
    'import --images HERE/frames/0.png --times HERE/frames/times.csv'
    ' --attitude HERE/frames/attitude.csv -o HERE/o'
)
FILES = {
    'BAG': 'diagnose FILE',
    'BAG of calibrate': 'calibrate FILE --params HERE/bag/params.yaml -o HERE/o',
    'file of a bag': 'diagnose HERE/bag/metadata.yaml',
    '--params': 'diagnose HERE/bag --params FILE',
    '--params of calibrate': 'calibrate HERE/bag --params FILE -o HERE/o',
    'camera_info_url': 'diagnose HERE/bag --params HERE/params.yaml',
    'catalog': 'diagnose HERE/bag --params HERE/params.yaml',
    '--pointings': 'plan HERE/bag --params HERE/bag/params.yaml --pointings FILE',
    'A': 'compare FILE HERE/out',
    'B': 'compare HERE/out FILE',
    'calibration.json': 'report HERE/out',
    'residuals.npz': 'report HERE/out',
    'observations.mcap': 'report HERE/out',
    'DIR of lookup': 'lookup FILE -o HERE/o.csv',
    'DIR of export': 'export FILE --to opencv -o HERE/o',
    '--kernels': 'export HERE/out --to ck --spacecraft-id -999 -o HERE/o --kernels FILE',
    'kernel of a meta-kernel': (
        'export HERE/out --to ck --spacecraft-id -999 -o HERE/o --kernels HERE/meta.tm'
    ),
    '--attitude': _IMPORT.replace('HERE/frames/attitude.csv', 'FILE'),
    '--attitude of a meta-kernel': _IMPORT.replace('HERE/frames/attitude.csv', 'HERE/meta.tm'),
    '--velocity': f'{_IMPORT} --velocity FILE',
    '--times': _IMPORT.replace('HERE/frames/times.csv', 'FILE'),
    '--camera': f'{_IMPORT} --camera FILE',
    'TABLE': 'catalog FILE -o HERE/o.npz',
    '--params of trend': 'trend HERE/bag -o HERE/o --params FILE',
}
"""Arguments and options that name a file; images are in the tests of their readers."""
PLACES = {
    'file of a bag': 'bag/metadata.yaml',
    'calibration.json': 'out/calibration.json',
    'residuals.npz': 'out/residuals.npz',
    'observations.mcap': 'out/observations.mcap',
}
"""Where the file is, if the command does not name it; in `MAY_LACK` it may be missing."""
MAY_LACK = ('file of a bag', 'residuals.npz', 'observations.mcap', '--params of trend')
CASES = [
    (name, kind)
    for name in FILES
    for kind in KINDS
    # One function opens files for all: where it refuses a pipe, it refuses the others too.
    if name in ('BAG', '--params') or kind in ('pipe', 'sparse', 'empty', 'garbage', 'other text')
]


@pytest.mark.parametrize(('name', 'kind'), CASES)
def test_a_file_that_is_none_costs_one_line(name, kind, campaign, tmp_path, starcal) -> None:
    here = tmp_path / 'campaign'
    shutil.copytree(campaign, here)
    file = here / PLACES.get(name, 'file')
    file.unlink(missing_ok=True)
    KINDS[kind](file)
    params = (here / 'bag/params.yaml').read_text().replace(': camera.yaml', ': bag/camera.yaml')
    if name == 'camera_info_url':
        (here / 'params.yaml').write_text(params.replace('bag/camera.yaml', 'file'))
    else:
        (here / 'params.yaml').write_text(f'{params}    {name}: {file}\n')
    parts = [f"'{str(here)[k : k + 40]}+'" for k in range(0, len(str(here)), 40)]
    (here / 'meta.tm').write_text(
        'KPL/MK\n\\begindata\nPATH_VALUES = (\n' + '\n'.join(parts).removesuffix("+'") + "' )\n"
        "PATH_SYMBOLS = ( 'HERE' )\nKERNELS_TO_LOAD = ( '$HERE/naif.tls' '$HERE/file' )\n"
    )
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    words = FILES[name].replace('HERE', str(here)).replace('FILE', str(file)).split()
    answer = starcal(*words)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < _MOST_BYTES // 1024
    if answer.status == 0 and name in MAY_LACK:
        return
    in_folder = Path(PLACES.get(name, '')).name  # which the command does not name
    assert_refused(answer, in_folder, 'not a regular file' if kind in ('pipe', 'device') else '')
