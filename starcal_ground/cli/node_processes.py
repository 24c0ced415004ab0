# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Nodes that the tool starts: one in its place, or those of the demonstration."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import importlib.util
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import tempfile
import time
from typing import NoReturn, TYPE_CHECKING

from starcal_ground.child_process import module_command
from starcal_ground.written_files import mark
from starcal_ros.errors import StarcalError

if TYPE_CHECKING:
    from starcal_ros.records import Calibration

Process = subprocess.Popen[bytes]

RATE = 5.0  # ten images in eight seconds
_START_S = 30.0  # longest start of the nodes
_QUIET_S = 10.0  # after the bag was played: no more images come
_NODES = ('star_observer', 'calibrator', 'setup_finder')


class NodeError(StarcalError):
    """A node did not start, or ended early."""


def check_ros() -> None:
    """
    Check that nodes can run.

    Raises NodeError where ROS, or the generated messages, cannot be imported.
    """
    for name in ('rclpy', 'starcal.msg'):
        try:
            is_there = importlib.util.find_spec(name) is not None
        except ModuleNotFoundError:
            is_there = False
        if not is_there:
            raise NodeError(
                f'no ROS nodes here: {name} is not installed; source a ROS 2 workspace with'
                ' starcal (docs/tutorial.md, "Run in the vehicle"), or calibrate without ROS:'
                ' starcal calibrate'
            )


def outputs(folder: Path) -> list[Path]:
    """The parameter file and the log files of a run."""
    logs = [folder / f'{name}.log' for name in (*_NODES, 'bag_player')]
    return [folder / 'demo_params.yaml', *logs]  # not params.yaml: a user's may be there


def calibrate_with_nodes(
    bag: Path,
    parameters: Mapping[str, object],
    image_count: int,
    folder: Path,
    on_image: Callable[[], None] = lambda: None,
) -> tuple[Calibration | None, str]:
    """
    Calibration of the nodes, None if refused, and the answer of their service.

    Starts the nodes, plays the bag and calls the service; images and calibration are read from the
    state folder of the calibrator, a temporary one.  Log files go to the folder.  All processes
    have ended when this returns.  Raises NodeError when a node does not start, or ends before the
    calibration.
    """
    import yaml

    from starcal_ground.written_files import write_marked
    from starcal_ros.formats.products.product_files import read_calibration

    params, *_ = outputs(folder)
    content = {'/**': {'ros__parameters': dict(parameters)}}
    write_marked(params, yaml.safe_dump(content, sort_keys=False))
    with contextlib.ExitStack() as stack:
        stack.enter_context(_ended_like_interrupted())
        is_given = 'ROS_DOMAIN_ID' in os.environ
        environment = {**os.environ, **({} if is_given else stack.enter_context(free_domain()))}
        state = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        nodes: dict[str, Process] = {}
        commands = {name: _node_command(name, params, state) for name in _NODES}
        commands['bag_player'] = [
            *node_command('bag_player', player_arguments(bag, RATE)),
            *('-p', 'wait_for_topic:=observations', '-p', f'wait_for_subscribers_s:={_START_S}'),
        ]
        for name, command in commands.items():
            log = stack.enter_context((folder / f'{name}.log').open('w+b'))
            stack.callback(mark, log)
            # Interrupted in here, the process would run on with nobody to end it.
            with _interrupts_wait():
                nodes[name] = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
                )
                stack.callback(_stop, nodes[name])
        _wait_for_images(image_count, state / 'ensemble', nodes, folder, on_image)
        answer = subprocess.run(
            node_command('starcal_ground.ros.calibrate_client', []),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=environment,
            text=True,
            check=False,
        )
        if answer.returncode:
            raise NodeError(f'{answer.stderr.strip()} (see the log files in {folder})')
        activated = next((state / 'calibrations').glob('*.json'), None)
        return (read_calibration(activated) if activated else None), answer.stdout.strip()


def _wait_for_images(
    count: int,
    ensemble: Path,
    nodes: dict[str, Process],
    folder: Path,
    on_image: Callable[[], None],
) -> None:
    """Wait until the calibrator has kept all images, or no more come after the bag was played."""
    kept, since_s = 0, time.monotonic()
    while kept < count:
        for name, node in nodes.items():
            if node.poll():  # the player ends by itself, with status 0
                said = (folder / f'{name}.log').read_text(errors='replace').strip()
                last = said.rpartition('\n')[2]
                raise NodeError(f'{name} ended before the calibration: {last}')
        saved = len(list(ensemble.glob('*.mcap')))
        if saved > kept or nodes['bag_player'].poll() is None:
            since_s = time.monotonic()
        elif time.monotonic() > since_s + _QUIET_S:
            return
        for _ in range(saved - kept):
            on_image()
        kept = saved
        time.sleep(0.05)


def become(name: str, arguments: Sequence[str], remaps: Sequence[str]) -> NoReturn:
    """
    Replace this process by a node; a Ctrl-C waits until that answers it without a traceback.

    Raises NodeError where nodes cannot run.
    """
    check_ros()
    sys.stdout.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        os.execv(sys.executable, node_command(name, arguments, remaps))
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _node_command(name: str, params: Path, state: Path) -> list[str]:
    from starcal_ground.simulation import simulated_bag

    topics = {
        'image': simulated_bag.IMAGE_TOPIC,
        'attitude': simulated_bag.ATTITUDE_TOPIC,
        'velocity': simulated_bag.VELOCITY_TOPIC,
    }
    remaps = [part for name, topic in topics.items() for part in ('-r', f'{name}:={topic}')]
    kept = ['-p', f'state_dir:={state}']
    return node_command(name, ['--ros-args', '--params-file', str(params), *kept, *remaps])


def node_command(name: str, arguments: Sequence[str], remaps: Sequence[str] = ()) -> list[str]:
    """Command line that runs a node or another module, with names replaced by others, ``A:=B``."""
    renamed = [part for remap in remaps for part in ('-r', remap)]
    ros_arguments = ['--ros-args', *renamed] if renamed else []
    return [*module_command('starcal_ros.entry_points'), name, *arguments, *ros_arguments]


def player_arguments(path: Path, rate: float) -> list[str]:
    """Parameters of the bag player."""
    return ['--ros-args', '-p', f'bag:={path.resolve()}', '-p', f'rate:={rate!r}']


@contextlib.contextmanager
def _ended_like_interrupted() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C, so that it stops the nodes too."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Raise the KeyboardInterrupt of a signal that comes in the block at its end."""
    came: list[int] = []
    numbers = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        if callable(signal.getsignal(number))  # not ignored
    ]
    before = [signal.signal(number, lambda got, _: came.append(got)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    if came:
        raise KeyboardInterrupt


def _stop(process: Process) -> None:
    """End a process, by SIGKILL if it ignores the milder signals."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            process.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5.0)


@contextlib.contextmanager
def free_domain() -> Iterator[dict[str, str]]:
    """Hold a ROS domain unused on this machine; its environment.  Raises NodeError without one."""
    first = os.getpid() % 100
    for domain in (1 + (first + k) % 100 for k in range(100)):
        # The first participant of a domain holds UDP port 7400 + 250 domain + 10 (RTPS 9.6.1.1).
        # None takes port + 2, which holds a domain whose participants are still to come.
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hold,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
        ):
            try:
                hold.bind(('', 7402 + 250 * domain))
                probe.bind(('', 7410 + 250 * domain))
            except OSError:
                continue
            probe.close()
            yield {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
            return
    raise NodeError('no free ROS domain on this machine: set ROS_DOMAIN_ID')
