"""The ladder: each module imports only those above it, and ROS stays in its room."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
import subprocess
import sys

import pytest

PACKAGE = Path(__file__).parents[1] / 'starcal_ros'

# In the order of the method: from numbers to images, stars, a calibration, and what comes of it.
LADDER = [
    'constants',
    'utc',
    'errors',
    'options',
    'robust',
    'camera',
    'records',
    'attitude',
    'catalog',
    'astrometry',
    'message_types',
    'message_fields',
    'image_messages',
    'telemetry_messages',
    'observation_messages',
    'status_messages',
    'calibration_messages',
    'screening',
    'fixed_pattern',
    'detection',
    'psf',
    'instrument',
    'centroiding',
    'prediction',
    'warp',
    'acquisition',
    'blends',
    'tearing',
    'brightness',
    'identification',
    'tracking',
    'measurement',
    'thermal',
    'least_squares',
    'adjustment',
    'covariance',
    'variance',
    'calibration',
    'observability',
    'removal',
    'agreement',
    'acceptance',
    'synthetic',
    'synthetic_images',
    'synthetic_centroids',
    'mcap_records',
    'bag',
    'product_files',
    'checked_values',
    'camera_info',
    'calibration_file',
    'archive',
    'residuals',
    'annotation',
    'thumbnails',
    'node_options',
    'camera_setup',
    'sequence',
    'provenance',
    'solution',
    'calibrator_state',
    'calibrator_reports',
    'sources',
    'inspection',
    'comparison',
    'comparison_figure',
    'terminal',
    'summaries',
    'simulation',
    'report_figures',
    'report_charts',
    'report',
    'campaign_trials',
    'campaign',
    'campaign_workers',
    'paper_study',
    'paper_figures',
    'campaign_figures',
    'demo',
    'arguments',
    'cli',
    'nodes.start',
    'nodes.conversions',
    'nodes.image_queue',
    'nodes.recent',
    'nodes.parameters',
    'nodes.lifecycle',
    'nodes.star_observer',
    'nodes.camera_driver',
    'nodes.calibrator',
    'nodes.bag_player',
    'nodes.demo_client',
]

MODULES = {
    '.'.join(path.relative_to(PACKAGE).with_suffix('').parts): path
    for path in sorted(PACKAGE.rglob('*.py'))
    if path.name != '__init__.py' and 'data' not in path.parts
}


def imported(path: Path) -> Iterator[str]:
    """Dotted names of all that a file imports, in functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, 'imports are absolute'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def test_every_module_has_its_place() -> None:
    assert set(MODULES) <= set(LADDER)


@pytest.mark.parametrize('name', MODULES)
def test_imports_go_down(name: str) -> None:
    above = LADDER[: LADDER.index(name)]
    for dotted in imported(MODULES[name]):
        if not dotted.startswith('starcal_ros.'):
            continue
        inside = dotted.removeprefix('starcal_ros.')
        wanted = next((m for m in MODULES if inside == m or inside.startswith(m + '.')), None)
        assert wanted is None or wanted in above, f'{name} imports {wanted}'


@pytest.mark.parametrize('name', [m for m in MODULES if not m.startswith('nodes.')])
def test_ros_stays_in_its_room(name: str) -> None:
    for dotted in imported(MODULES[name]):
        root = dotted.partition('.')[0]
        is_ros = root in ('rclpy', 'starcal', 'std_srvs', 'builtin_interfaces', 'rcl_interfaces')
        assert not is_ros and not root.endswith('_msgs'), f'{name} imports {dotted}'


ALONE = """
import importlib, sys
for name in sys.argv[1:]:
    for known in [m for m in sys.modules if m.split('.')[0] == 'starcal_ros']:
        del sys.modules[known]
    importlib.import_module('starcal_ros.' + name)
    print(name)
assert 'rclpy' not in sys.modules
"""


def test_no_start_waits_for_scipy_stats() -> None:
    """Of the second that a node or a calibration needs to start, it would make a third more."""
    show = 'import sys; from starcal_ros import sequence, solution; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', show], capture_output=True, text=True, check=True)
    assert 'scipy.special' in done.stdout.split() and 'scipy.stats' not in done.stdout.split()


def test_each_module_imports_alone() -> None:
    """No module needs another to have been imported first; none pulls ROS in."""
    names = [m for m in MODULES if not m.startswith('nodes.')]
    done = subprocess.run(
        [sys.executable, '-c', ALONE, *names], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == names
