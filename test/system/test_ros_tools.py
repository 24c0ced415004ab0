# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes and launch files with the real ROS 2 tools, on Fast DDS and on Cyclone DDS."""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
from functools import partial
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from mission_files import params_with  # type: ignore[import-not-found]
import pytest
from starcal_tool import run_python  # type: ignore[import-not-found]

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from diagnostic_msgs.msg import DiagnosticArray
from ros_tools import find_tools, HIDDEN, RosTools  # type: ignore[import-not-found]
from rosbags.convert import convert

from starcal_ground.bags import reader
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.records import Activation, Ensemble
from starcal_ros.ros.archive import Archive

pytestmark = pytest.mark.nodes

ROOT = Path(__file__).parents[2]
TINY = ROOT / 'bags' / 'tiny'
FAST, CYCLONE = 'rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp'
ANSWER_S = 30.0  # of a transition, which takes 2 s with the start of the tool
TRIGGER = 'std_srvs/srv/Trigger'
STATUS = 'starcal/msg/EnsembleStatus'
# With the type, so that no daemon is asked, which has the keys of whoever started it.
LATCHED = ('--qos-durability', 'transient_local', '--qos-reliability', 'reliable')
ECHO = ('topic', 'echo', '--once', *LATCHED)
Make = Callable[..., RosTools]


@pytest.fixture(scope='module')
def tools(made_once: Callable[..., Path]) -> Path:
    found: Path = find_tools(made_once)
    return found


@pytest.fixture(scope='module')
def rosbag2(tools: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Skip a test where the libraries of rosbag2 do not load; its commands are missing then."""
    ros2 = RosTools(tools, FAST, tmp_path_factory.mktemp('rosbag2'), {})
    if ' record ' not in ros2.run('bag', '--help').stdout:
        pytest.skip('rosbag2 does not load here')


@pytest.fixture
def make(tools: Path, tmp_path: Path, has_failed: Callable[[], bool]) -> Iterator[Make]:
    made: list[RosTools] = []

    def make(rmw: str, **more: str) -> RosTools:
        logs = tmp_path / f'logs{len(made)}'
        logs.mkdir()
        made.append(RosTools(tools, rmw, logs, {'ROS_LOG_DIR': str(logs), **more}))
        return made[-1]

    yield make
    for one in made:
        one.close(has_failed())


@pytest.fixture(params=[FAST, CYCLONE])
def ros2(make: Make, request: pytest.FixtureRequest) -> RosTools:
    return make(request.param)


def test_launch_replay_calibrate_and_record(rosbag2, ros2, tiny_bag, tmp_path) -> None:
    """The sequence of the README with every launch argument, ended as a terminal ends it."""
    recorded = tmp_path / 'recorded'
    launch = ros2.start(
        *('launch', 'starcal', 'starcal.launch.py', f'params_file:={tiny_bag}/params.yaml'),
        *('namespace:=opnav', 'log_level:=info', 'autostart:=true', 'use_sim_time:=false'),
        *('respawn:=false', 'image:=/opnav/image_raw', 'attitude:=/star_tracker/attitude'),
        *('velocity:=/velocity', 'temperature:=/temperature'),
    )
    for _ in range(2):  # nodes
        launch.until_said('active, listening to ')
    topics = ('/opnav/observations', '/opnav/calibration', '/tf_static')
    record = ros2.start('bag', 'record', '--storage', 'mcap', '-o', recorded, *topics)
    record.until_said("Subscribed to topic '/opnav/observations'")
    ros2.until('Subscription count: 2', 'topic', 'info', '/opnav/observations')
    played = ros2.run('bag', 'play', tiny_bag, '--delay', '3')
    assert played.returncode == 0, played.stderr
    images = 'images: 10\n'
    ros2.until(images, *ECHO, '/opnav/ensemble_status', STATUS)
    answer = ros2.run('service', 'call', '/opnav/calibrator/calibrate', TRIGGER)
    assert 'success=True' in answer.stdout, answer.stdout + launch.said()
    static = ros2.run('topic', 'echo', '--once', '/tf_static', 'tf2_msgs/msg/TFMessage')
    assert 'child_frame_id: camera' in static.stdout, static.stderr
    record.until_said("Subscribed to topic '/opnav/calibration'")
    assert record.interrupt_group() == 0, record.said()
    counts = {topic.name: topic.count for topic in reader.topics([recorded])}
    assert counts == {'/opnav/observations': 10, '/opnav/calibration': 1, '/tf_static': 1}
    launch.interrupt_group()
    assert launch.said().count('process has finished cleanly') == 2, launch.said()


def test_launch_arguments_are_shown_and_a_missing_one_is_named(make) -> None:
    for file in ('starcal.launch.py', 'replay.launch.py'):
        shown = make(FAST).run('launch', 'starcal', file, '--show-args')
        assert shown.returncode == 0 and "'params_file':" in shown.stdout, shown.stderr
    make(FAST).start('launch', 'starcal', 'starcal.launch.py').until_said('camera_info_url')


def test_replay_launch(make, client, tiny_bag, tmp_path) -> None:
    ros2 = make(FAST)
    params = params_with(tmp_path, state_dir=str(tmp_path / 'state'))
    launch = ros2.start(
        *('launch', 'starcal', 'replay.launch.py', f'params:={params}', f'bag:={tiny_bag}'),
        *('rate:=0.0', 'loop:=false', 'image:=/opnav/image_raw'),
        'attitude:=/star_tracker/attitude',
    )
    client.until_images(10)
    launch.interrupt_group()
    assert 'process has died' not in launch.said(), launch.said()
    if ' record ' not in ros2.run('bag', '--help').stdout:  # the libraries do not load
        return
    info = ros2.run('bag', 'info', tmp_path / 'state' / 'ensemble' / '00000001.mcap')
    words = info.stdout.split()
    assert words[words.index('Messages:') + 1] == '1', info.stdout + info.stderr


@pytest.mark.parametrize(
    ('argument', 'says'),
    [('rate:=abc', "bag_player: rate: 'abc' is not a number"), ('respawn:=abc', "got 'abc'")],
)
def test_a_wrong_argument_leaves_no_process(make, tiny_bag, tmp_path, argument, says) -> None:
    """The launch ends by itself, and the nodes with it: another calibrator can have the folder."""
    ros2 = make(FAST)
    params = params_with(tmp_path, state_dir=str(tmp_path / 'state'))
    files = (f'params_file:={params}', f'bag:={tiny_bag}')
    launch = ros2.start('launch', 'starcal', 'replay.launch.py', *files, argument)
    launch.wait()
    assert says in launch.said()
    with pytest.raises(ProcessLookupError):
        os.killpg(launch.process.pid, 0)
    Archive(tmp_path / 'state', 'camera').close()


def test_two_cameras_with_one_frame_are_named(make, client, tiny_bag, tiny, tmp_path) -> None:
    """In namespaces of their own, but with one transform; another name of the frame mends it."""
    ros2 = make(FAST)
    params = ('--params-file', tiny_bag / 'params.yaml')
    for k, name in enumerate(('left', 'right', 'third')):
        frame = 'third' if name == 'third' else tiny.child_frame
        stamps = {'active_since_ns': 1, 'time_ns': tiny.time_ns + k}
        one = dataclasses.replace(tiny, number=1, child_frame=frame, **stamps)
        with contextlib.closing(Archive(tmp_path / name, frame)) as archive:
            archive.keep(Ensemble(), (Activation(1, 0, one),))
        options = ('-r', f'__ns:=/{name}', '-p', f'state_dir:={tmp_path / name}')
        ros2.start_node('calibrator', *params, *options, '-p', f'camera_frame:={frame}')
    told: list[Any] = client.collect(DiagnosticArray, '/diagnostics')

    def message(name: str) -> str:
        heard = [one.status[0] for one in told if f'{name}/calibrator' in one.status[0].name]
        return str(heard[-1].message) if heard else ''

    says = f'/tf_static: another node publishes {tiny.child_frame} too: give each camera its own'
    for name in ('left', 'right'):
        client.until(lambda name=name: message(name).startswith(says))
    client.until(lambda: message('third') == 'calibration active')


def test_lifecycle_and_parameters(make, tiny_bag, tmp_path) -> None:
    """Each transition by its name; services answer while inactive; a dump can be read again."""
    ros2 = make(CYCLONE)  # on Fast DDS, test_node_lifecycle.py calls the same services
    node = ros2.start_node(
        *('calibrator', '--params-file', tiny_bag / 'params.yaml'), *('-p', 'autostart:=false')
    )
    ros2.until('unconfigured', 'lifecycle', 'get', '/calibrator')
    for transition, state in (
        ('configure', 'inactive'),
        ('activate', 'active'),
        ('deactivate', 'inactive'),
        ('cleanup', 'unconfigured'),
    ):
        # An answer is lost where the node has not discovered its client yet: the tool then waits
        # for ever, but the node has made the transition.
        with contextlib.suppress(subprocess.TimeoutExpired):
            made = ros2.run('lifecycle', 'set', '/calibrator', transition, timeout_s=ANSWER_S)
            assert 'Transitioning successful' in made.stdout, made.stderr + node.said()
        ros2.until(state, 'lifecycle', 'get', '/calibrator')
        if state == 'inactive':
            answer = ros2.run('service', 'call', '/calibrator/calibrate', TRIGGER)
            assert "message='not active: inactive'" in answer.stdout, answer.stderr
    changed = ros2.run('param', 'set', '/calibrator', 'min_images', '5')
    assert 'successful' in changed.stdout, changed.stderr
    refused = ros2.run('param', 'set', '/calibrator', 'star_tracker_sigma_arcsec', '[-1.0, 2.0]')
    assert 'array(' not in refused.stdout + refused.stderr
    assert 'star_tracker_sigma_arcsec: ' in refused.stdout + refused.stderr
    dump = tmp_path / 'dump.yaml'
    dump.write_text(ros2.until('min_images: 5', 'param', 'dump', '/calibrator'))
    assert node.interrupt_group() == 0
    again = ros2.start_node('calibrator', '--params-file', dump)
    ros2.until('Integer value is: 5', 'param', 'get', '/calibrator', 'min_images')
    assert 'not a parameter' not in again.said()


OPERATOR = """<?xml version="1.0" encoding="UTF-8"?>
<policy version="0.2.0">
  <enclaves>
    <enclave path="/operator">
      <profiles>
        <profile ns="/" node="*">
          <topics publish="ALLOW" subscribe="ALLOW"><topic>*</topic></topics>
          <services reply="ALLOW" request="ALLOW"><service>*</service></services>
        </profile>
      </profiles>
    </enclave>
  </enclaves>
</policy>
"""


def test_policies_are_enforced(make, tiny_bag, tmp_path) -> None:
    """The nodes work; an outsider sees and calls nothing; a node in a wrong enclave is denied."""
    pytest.importorskip('lxml')
    pytest.importorskip('cryptography')
    keys = tmp_path / 'keys'
    outsider = make(CYCLONE)
    policies = {path.name.partition('.')[0]: path for path in SECURITY.glob('*.policy.xml')}
    assert set(policies) == {*('star_observer', 'calibrator', 'bag_player', 'setup_finder')}
    policies['operator'] = tmp_path / 'operator.policy.xml'
    policies['operator'].write_text(OPERATOR)
    done(outsider.run('security', 'create_keystore', keys))
    for name, policy in policies.items():
        done(outsider.run('security', 'create_enclave', keys, f'/{name}'))
        done(outsider.run('security', 'create_permission', keys, f'/{name}', policy))
    enforced = {
        'ROS_SECURITY_ENABLE': 'true',
        'ROS_SECURITY_STRATEGY': 'Enforce',
        'ROS_SECURITY_KEYSTORE': str(keys),
    }
    nodes = make(CYCLONE, **enforced)
    operator = make(CYCLONE, **enforced, ROS_SECURITY_ENCLAVE_OVERRIDE='/operator')

    params = ('--params-file', tiny_bag / 'params.yaml')
    observer = nodes.start_node('star_observer', '--enclave', '/star_observer', *params)
    calibrator = nodes.start_node('calibrator', '--enclave', '/calibrator', *params)
    for node in (observer, calibrator):
        node.until_said('active, listening to ')
    topics = ('/opnav/image_raw:=/image', '/star_tracker/attitude:=/attitude')
    remaps = [a for one in (*topics, '/spacecraft/velocity:=/velocity') for a in ('-r', one)]
    bag = ('-p', f'bag:={tiny_bag}', '-p', 'rate:=0.0', *remaps)
    player = nodes.start_node('bag_player', '--enclave', '/bag_player', *bag)
    assert player.wait() == 0, player.said()
    operator.until('images: 10\n', *ECHO, '/ensemble_status', STATUS)
    answer = operator.run('service', 'call', '/calibrator/calibrate', TRIGGER)
    assert 'success=True' in answer.stdout, answer.stdout + calibrator.said()

    listed = done(outsider.run('node', 'list', '--no-daemon', '--spin-time', '5'))
    assert 'calibrator' not in listed and 'star_observer' not in listed
    with pytest.raises(subprocess.TimeoutExpired):
        outsider.run('service', 'call', '/calibrator/reset', TRIGGER, timeout_s=15.0)
    assert 'images: 10\n' in done(operator.run(*ECHO, '/ensemble_status', STATUS))

    denied = nodes.start_node('calibrator', '--enclave', '/bag_player', *params)
    assert denied.wait() != 0, denied.said()


SECURITY = ROOT / 'config' / 'security'


def done(process: subprocess.CompletedProcess[str]) -> str:
    assert process.returncode == 0, process.stderr
    return process.stdout


def as_sqlite(folder: Path) -> None:
    nothing = [()] * 4  # no topics or types are left out, or taken alone
    convert([TINY], folder, 'sqlite3', 9, None, '', None, None, *nothing)


def as_damaged(folder: Path) -> None:
    folder.mkdir()
    content = bytearray((TINY / 'tiny_0.mcap').read_bytes())
    content[700_000:700_020] = bytes(20)  # in the first chunk of two
    (folder / 'bag.mcap').write_bytes(content)


def as_cut_off(folder: Path) -> None:
    folder.mkdir()
    (folder / 'bag.mcap').write_bytes((TINY / 'tiny_0.mcap').read_bytes()[:900_000])


def as_no_database(folder: Path) -> None:
    folder.mkdir()
    (folder / 'bag.db3').write_bytes(b'SQLite format 3\0' + bytes(1000))


@pytest.mark.parametrize(
    ('write', 'line'),
    [
        (partial(shutil.copytree, TINY), ''),
        (as_sqlite, ''),
        (as_damaged, 'damaged, rosbag2 reads only a part: {install}, which reads what is intact'),
        (as_cut_off, 'rosbag2 finds no message in it: if it is cut off, {install}'),
        (as_no_database, 'rosbag2 cannot open it (No storage could be initialized'),
    ],
    ids=['mcap', 'sqlite', 'damaged', 'cut off', 'no database'],
)
def test_without_the_wheels_rosbag2_reads_bags(
    write, line, make, rosbag2, tiny_products, tmp_path
) -> None:
    ros2 = make(FAST)
    write(tmp_path / 'bag')
    (tmp_path / 'sitecustomize.py').write_text(HIDDEN)
    path = f'{tmp_path}:{ROOT}:{ros2.environment["PYTHONPATH"]}'
    words = ('calibrate', 'bag', '--params', TINY / 'params.yaml', '-o', 'out')
    env = ros2.environment | {'PYTHONPATH': path}
    done = run_python('-m', 'starcal_ground.cli.main', *words, env=env, cwd=tmp_path)
    install = f'{sys.executable} -m pip install mcap rosbags'
    if line:
        assert done.returncode == 2 and line.format(install=install) in done.stderr
        starts = ('bag/', 'out/', 'starcal: ')  # nothing of rosbag2's own
        assert all(text.startswith(starts) for text in done.stderr.splitlines()), done.stderr
        return
    unwritten = (
        f'out/observations.mcap is not written: mcap or rosbags is not installed: {install}\n'
    )
    assert (done.returncode, done.stderr) == (0, unwritten), done.stderr
    camera, expected = (
        read_calibration(folder / CALIBRATION_FILE).geometry.camera
        for folder in (tmp_path / 'out', tiny_products)
    )
    assert camera.parameters.tolist() == expected.parameters.tolist()
