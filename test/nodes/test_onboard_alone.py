# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The onboard package with what it needs alone: nodes, a calibration and a consumer of it."""

from importlib import metadata
import json
from pathlib import Path

from ament_index_python.packages import get_packages_with_prefixes
import pytest
from ros_tools import required  # type: ignore[import-not-found]
from starcal_tool import run_python  # type: ignore[import-not-found]
from vehicle import BOTH, REMAPS  # type: ignore[import-not-found]

from starcal.msg import Calibration
import starcal_ros
from starcal_ros.formats.messages.record_messages import calibration_from_message

pytestmark = [pytest.mark.nodes, pytest.mark.usefixtures('onboard')]

ROOT = Path(__file__).parents[2]
# mcap and rosbags read bags and the state folder; a node without state_dir needs neither.
ONBOARD = ('numpy', 'scipy', 'opencv-python-headless', 'pyerfa', 'PyYAML', 'mcap', 'rosbags')
ON_THE_GROUND = (
    *('starcal_ground', 'studies', 'bench', 'tools'),
    *('PIL', 'argcomplete', 'astropy', 'dask', 'jinja2', 'rich', 'threadpoolctl'),
)
# Python runs it before anything else.
SITECUSTOMIZE = """
import sys

class Onboard:
    def find_spec(self, name, path=None, target=None):
        top = name.partition('.')[0]
        is_of_python = top in sys.stdlib_module_names or top.startswith('_sysconfigdata')
        if not is_of_python and top not in {allowed}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Onboard())
"""
IMPORTED = """
import importlib, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        print(error.name)
"""
READ = """
import json, sys
import starcal_ros
found = starcal_ros.read_calibration(sys.argv[1])
sight = starcal_ros.lines_of_sight(found, [0.0, 0.0], 'star_tracker')
print(json.dumps([found.accepted, found.images_used, sight.tolist()]))
"""


@pytest.fixture
def onboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The processes that a test starts import nothing that does not fly."""
    names = {*ONBOARD}.union(*(required(metadata.distribution(name)) for name in ONBOARD))
    files = [file for name in names for file in metadata.files(name) or ()]
    tops = {Path(file.parts[0]).name.partition('.')[0] for file in files}
    allowed = sorted({*tops, *get_packages_with_prefixes(), 'starcal_ros', 'sitecustomize'})
    assert not {*ON_THE_GROUND} & {*allowed}
    (tmp_path / 'sitecustomize.py').write_text(SITECUSTOMIZE.format(allowed=allowed))
    monkeypatch.setenv('PYTHONPATH', f'{tmp_path}:{ROOT}')


def test_what_stays_on_the_ground_cannot_be_imported() -> None:
    done = run_python('-c', IMPORTED, *ON_THE_GROUND)
    assert (done.returncode, done.stdout.split()) == (0, [*ON_THE_GROUND])


def test_nodes_calibrate_and_a_consumer_reads_the_calibration(
    vehicle, few_images, tmp_path, monkeypatch
) -> None:
    """Of the messages of a player on the ground, with a state folder."""
    vehicle.bag = few_images
    for name in BOTH:
        vehicle.start(name, f'state_dir:={tmp_path}/kept', ros=REMAPS, forked=False)
    vehicle.until_listened()
    ros = ('-p', f'bag:={vehicle.bag}', '-p', 'rate:=0.0')
    with monkeypatch.context() as on_ground:
        on_ground.delenv('PYTHONPATH')
        player = vehicle.start_node('bag_player', *ros, forked=False)
    assert player.wait() == 0, player.said()
    vehicle.until_images(3, 'images_saved')
    vehicle.calibrate()
    published = vehicle.until_latched(Calibration, 'calibration')
    done = run_python('-c', READ, tmp_path / 'kept')
    assert (done.returncode, done.stderr) == (0, '')
    is_accepted, images, sight = json.loads(done.stdout)
    assert is_accepted and published[0].accepted
    assert images == published[0].images_used == 3
    expected = starcal_ros.lines_of_sight(
        calibration_from_message(published[0]), [0.0, 0.0], 'star_tracker'
    )
    assert sight == expected.tolist()
