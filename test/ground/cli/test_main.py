# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The tool from a user's side: exit status, one line for bad input, never a traceback."""

import argparse
from collections import Counter
import importlib.util
import os
from pathlib import Path
import re
import shlex
import shutil
import signal
import subprocess
import sys

from mission_files import TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from starcal_tool import assert_refused, run_python  # type: ignore[import-not-found]

from starcal_ground.child_process import module_command
from starcal_ground.cli import main, node_processes
from starcal_ground.cli.arguments import EXIT_INTERRUPTED, parse_time, Selection
from starcal_ground.cli.commands import compare, demo
from starcal_ground.cli.main import COMMANDS, parser
from starcal_ros.constants import software_version


def test_help_without_a_command_and_version(starcal) -> None:
    assert starcal() == (0, parser().format_help(), '')
    assert starcal('--version') == (0, f'starcal {software_version()}\n', '')


def test_lookup_writes_the_columns_of_the_document(starcal, tmp_path, tiny_products) -> None:
    text = (Path(__file__).parents[3] / 'docs' / 'commands.md').read_text()
    (row,) = (line for line in text.splitlines() if line.startswith('| `starcal lookup '))
    lookup_columns = re.findall(r'`(\w+)`', row.split('|', 2)[2])
    file = tmp_path / 'table.csv'
    status, out, err = starcal('lookup', tiny_products, '-o', file)
    assert (status, err) == (0, '')
    assert '625 lines of sight' in out and str(file) in out
    table = np.genfromtxt(file, delimiter=',', names=True)
    assert list(table.dtype.names or ()) == lookup_columns
    assert len(table) == 25 * 25
    # From corner to corner, u fastest.
    assert (table['u_px'][0], table['v_px'][0]) == (0.0, 0.0)
    assert (table['u_px'][24], table['v_px'][24]) == (639.0, 0.0)
    assert (table['u_px'][-1], table['v_px'][-1]) == (639.0, 511.0)
    file, product = tmp_path / 'table.npz', tiny_products / 'calibration.json'
    status, _, err = starcal('lookup', product, '-o', file, '--points', 3)
    assert (status, err) == (0, '')
    with np.load(file) as archive:
        assert list(archive.files) == lookup_columns
        assert sorted(set(archive['u_px'])) == [0, 319.5, 639]
        assert sorted(set(archive['v_px'])) == [0, 255.5, 511]


def examples() -> list[tuple[str, list[str]]]:
    """Every line of example in the helps, by command."""
    (commands,) = (a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    epilogs = {'': parser().epilog, **{n: c.epilog for n, c in commands.choices.items()}}
    return [
        (name, shlex.split(line))
        for name, epilog in epilogs.items()
        for line in str(epilog).replace('\\\n', ' ').splitlines()
        if line.startswith('  starcal ')
    ]


def test_each_command_has_examples_that_it_takes() -> None:
    shown = Counter(name for name, _ in examples())
    often = ('diagnose', 'calibrate', 'compare', 'simulate', 'play')
    assert all(shown[name] >= 2 for name in often)
    assert set(shown) == {'', *COMMANDS}
    folder = Path(main.__file__).parent / 'commands'
    files = {path.stem.strip('_') for path in folder.glob('*.py')}
    assert files == {'init', *COMMANDS}  # a command is one file
    for _, words in examples():
        parser().parse_args(words[1:])  # exits where it does not understand


@pytest.mark.packaging
@pytest.mark.slow
def test_the_first_steps_run_in_an_empty_folder(starcal, tmp_path, monkeypatch) -> None:
    """As after `pip install`, where there is neither ROS nor the bag of the repository."""
    monkeypatch.chdir(tmp_path)
    *steps, demo_step = [words[1:] for name, words in examples() if not name]
    assert [words[0] for words in steps] == ['simulate', 'calibrate', 'compare']
    for words in steps:
        assert starcal(*words)[0] == 0, words
    assert demo_step == ['demo']


@pytest.mark.parametrize(
    'line', ['demo -o {t}/out', 'play {b}', 'monitor --once 1'], ids=lambda line: line.split()[0]
)
@pytest.mark.parametrize('missing', ['rclpy', 'starcal'])
def test_what_needs_ros_names_it(starcal, tmp_path, monkeypatch, line, missing) -> None:
    for name in [name for name in sys.modules if name.partition('.')[0] == missing]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)  # cannot be imported
    monkeypatch.setitem(sys.modules, 'starcal_ground.report', None)  # ROS is named first
    result = starcal(*line.format(t=tmp_path, b=TINY).split())
    assert_refused(result, missing, 'is not installed', 'source a ROS 2 workspace')
    assert 'starcal calibrate' in result[2]
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('line', 'expected'),
    [
        ('starcal ca', ['calibrate', 'catalog']),
        ('starcal diagnose --ima', ['--image-topic']),
        ('starcal simulate --scenario ', ['narrow', 'paper', 'small', 'tiny']),
        ('starcal import --channel g', ['green']),
        (f'starcal diagnose {TINY}/tiny_0', [f'{TINY}/tiny_0.mcap']),
    ],
)
def test_a_shell_completes(line, expected, tmp_path) -> None:
    """What argcomplete's function in the shell asks the tool, and what it is told."""
    told = tmp_path / 'told'
    asked = {
        '_ARGCOMPLETE': '1',
        '_ARGCOMPLETE_IFS': '\n',
        '_ARGCOMPLETE_STDOUT_FILENAME': str(told),
        '_ARGCOMPLETE_SUPPRESS_SPACE': '0',
        'COMP_LINE': line,
        'COMP_POINT': str(len(line)),
        'COMP_TYPE': '9',
    }
    subprocess.run(
        [sys.executable, '-m', 'starcal_ground.cli.main'], env={**os.environ, **asked}, check=False
    )
    found = told.read_text().split('\n')
    assert sorted(word.strip() for word in found) == expected


@pytest.mark.parametrize(
    ('line', 'module', 'arguments'),
    [
        (
            f'play {TINY} --rate 2 --remap a:=b --remap c:=d',
            'bag_player',
            f'--ros-args -p bag:={TINY.resolve()} -p rate:=2.0 --ros-args -r a:=b -r c:=d',
        ),
        # It was once renamed without its command.
        (
            'monitor --once 2.5 --remap __ns:=/cam1',
            'starcal_ground.ros.monitor_client',
            '--once 2.5 --ros-args -r __ns:=/cam1',
        ),
    ],
)
def test_a_command_becomes_its_node(starcal, monkeypatch, line, module, arguments) -> None:
    called: list[list[str]] = []
    monkeypatch.setattr('os.execv', lambda path, arguments: called.append(arguments))
    starcal(*line.split())
    entry = module_command('starcal_ros.entry_points')
    assert called == [[*entry, module, *arguments.split()]]
    assert '.' not in module or importlib.util.find_spec(module)


def test_demo_takes_the_bag_of_the_repository_or_makes_one(tmp_path, monkeypatch) -> None:
    bag = demo.tiny_bag(tmp_path)
    assert bag.bag == TINY
    assert bag.image_count == 10
    assert bag.parameters['camera_info_url'] == f'file://{(TINY / "camera.yaml").resolve()}'
    assert not any(tmp_path.iterdir())
    monkeypatch.setattr(demo, '__file__', str(tmp_path / 'package' / 'demo.py'))
    monkeypatch.setenv('AMENT_PREFIX_PATH', '')
    bag = demo.tiny_bag(tmp_path)
    assert bag.bag == tmp_path / 'tiny'
    shutil.rmtree(bag.bag)


@pytest.mark.slow
def test_demo_says_which_node_failed(starcal, tmp_path, monkeypatch) -> None:
    failing = [sys.executable, '-c', 'import sys; print("no such thing"); sys.exit(1)']
    waiting = [sys.executable, '-c', 'import time; time.sleep(60)']
    monkeypatch.setattr(
        node_processes,
        'node_command',
        lambda name, *_: failing if name == 'calibrator' else waiting,
    )
    assert_refused(starcal('demo', '-o', tmp_path), 'calibrator', 'no such thing')


def test_another_error_of_an_import_stays(monkeypatch) -> None:
    def broken(_args: object) -> int:
        raise ImportError('libfreetype is not there')

    monkeypatch.setattr(compare, 'run', broken)
    with pytest.raises(ImportError, match='libfreetype'):
        main.main(['compare', 'a', 'b'])


CTRL_C = """
import os, signal, sys, time
from pathlib import Path
from starcal_ground.cli import entry_point, node_processes
from starcal_ground.cli.commands import diagnose

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
"""
# As NumPy raises it, whose import of its own modules catches ImportError.
WITHOUT_CAUSE = """
def interrupted(_args):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        pass
    raise ModuleNotFoundError('Error importing numpy')

diagnose.run = interrupted
sys.argv = ['starcal', 'diagnose', 'x']
sys.exit(entry_point.main())
"""
WHILE_THE_PLAYER_STARTS = """
become = os.execv
os.execv = lambda *command: (os.kill(os.getpid(), signal.SIGINT), become(*command))
node_processes.become('bag_player', node_processes.player_arguments(Path('none'), 1.0), [])
"""


@pytest.mark.parametrize(
    ('code', 'expected'),
    [
        (WITHOUT_CAUSE, (EXIT_INTERRUPTED, 'starcal: interrupted\n')),
        (WHILE_THE_PLAYER_STARTS, (-signal.SIGINT, '')),
    ],
)
def test_a_ctrl_c_is_one_line_or_none(code, expected) -> None:
    done = run_python('-c', CTRL_C + code)
    assert (done.returncode, done.stderr) == expected


def test_an_interrupt_while_a_node_starts_waits_until_it_is_known() -> None:
    seen: list[str] = []
    before = signal.getsignal(signal.SIGTERM)

    def start() -> None:
        with node_processes._ended_like_interrupted(), node_processes._interrupts_wait():
            os.kill(os.getpid(), signal.SIGTERM)
            seen.append('the rest of the block')

    with pytest.raises(KeyboardInterrupt):
        start()
    assert seen
    assert signal.getsignal(signal.SIGTERM) is before


STAMPS_NS = [(1_778_829_600 + 10 * k) * 1_000_000_000 for k in range(12)]


def test_between_two_times() -> None:
    for start, end, expected in (
        ('+20', '+50', [2, 3, 4, 5]),
        ('1778829680', None, [8, 9, 10, 11]),
        ('2026-05-15T07:20:20', '2026-05-15T07:20:40Z', [2, 3, 4]),
    ):
        wanted = Selection(parse_time(start), None if end is None else parse_time(end))
        assert [k for k, stamp in enumerate(STAMPS_NS) if wanted(stamp)] == expected
