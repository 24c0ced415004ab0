# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Fixtures for tests with nodes: a separate ROS domain, node processes, a client."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
import contextlib
import dataclasses
import fcntl
import functools
import gc
import inspect
import io
import os
from pathlib import Path
import shutil
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from forked_process import ForkedChild, ForkedNode, ForkedProcess  # type: ignore[import-not-found]
import hypothesis
import pytest

# Read when NumPy is loaded: two tests at once on two cores leave no core for more threads.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# The background of a shell ignores Ctrl-C, and what is started there inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same cases in each run; by default, a busy machine makes them fail for their time.
hypothesis.settings.register_profile(
    'any machine',
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile('any machine')

START_S = 240.0  # a node starts in 2 s; much slower on two busy cores
SLOW_S = 5.0  # of processor time: more than a test of one second takes on most machines
FAILED = pytest.StashKey[bool]()  # in the stash of a test
TINY = Path(__file__).parents[1] / 'bags' / 'tiny'
# Files of eight seconds and more, longest first: at the end, one of them would keep one worker
# while the others wait.
LONGEST = (
    *('test_colcon', 'test_bench', 'test_calibrate', 'test_night_sky', 'test_monte_carlo'),
    *('test_problem_temperature', 'test_arguments_output', 'test_first_setup', 'test_campaign'),
    *('test_docs', 'test_problem_mountings', 'test_motion', 'test_deep_catalog', 'test_kills'),
    *('test_worlds', 'test_processes', 'test_search', 'test_trust', 'test_set_up_mistakes'),
    *('test_lens_models', 'test_object_store', 'test_end_to_end', 'test_unknown_air'),
    *('test_centroiding', 'test_c_camera', 'test_series_overview', 'test_trend', 'test_state'),
    *('test_hostile_state', 'test_ros_tools', 'test_hostile_messages', 'test_plan'),
    *('test_calibrator_camera_driver', 'test_paper', 'test_examples'),
)


def pytest_configure(config: pytest.Config) -> None:
    """Have pytest-xdist keep the order below; it would begin with the files of most tests."""
    config.option.loadscopereorder = False


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Look for no garbage among modules and tests, which stay: it is 4 % of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest."""
    place = {stem: k for k, stem in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Store for `has_failed` that a test has failed."""
    report = yield
    item.stash[FAILED] = item.stash.get(FAILED, False) or report.failed
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Note a test that takes `SLOW_S` of processor time and is not marked ``slow``."""
    before_s = sum(os.times()[:4])
    yield
    took_s = sum(os.times()[:4]) - before_s
    if took_s > SLOW_S and not {'slow', 'nodes'} & {mark.name for mark in item.iter_markers()}:
        item.user_properties.append(('to_mark_slow_s', took_s))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name those tests; none fails, since a busy machine makes every test slow."""
    for report in terminalreporter.getreports('passed'):
        if report.when == 'call':
            for name, took_s in report.user_properties:
                if name == 'to_mark_slow_s':
                    terminalreporter.write_line(
                        f'mark it slow: {report.nodeid} took {took_s:.1f} s of processor time'
                    )


MadeOnce = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope='session')
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    """
    Folders by name, each filled by the first worker of a run that needs it.

    Tests must not change them.
    """
    base = tmp_path_factory.getbasetemp()
    if 'PYTEST_XDIST_WORKER' in os.environ:
        base = base.parent  # of all workers

    def made(name: str, fill: Callable[[Path], object]) -> Path:
        folder = base / f'once_{name}'
        with folder.with_suffix('.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                part = tmp_path_factory.mktemp(name)
                fill(part)
                part.rename(folder)
        return folder

    return made


def free_domain() -> int:
    """Return a ROS domain without participants on this machine, of no other worker."""
    # Workers choose before any of them has a participant: each has every n-th domain.
    workers = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
    worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
    rounds = 100 // workers
    start = os.getppid() if workers > 1 else os.getpid()
    for k in range(rounds):
        domain = 1 + worker + workers * ((start + k) % rounds)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                # The first participant of a domain holds this port (RTPS 9.6.1.1).
                probe.bind(('', 7410 + 250 * domain))
            except OSError:
                continue
            return domain
    raise RuntimeError('no free ROS domain on this machine')


@pytest.fixture(scope='session')
def ros_domain() -> Iterator[None]:
    """Set an unused ROS domain in the environment, for this process and its node processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(free_domain()))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        yield


@pytest.fixture(autouse=True)
def domain_of_node_tests(request: pytest.FixtureRequest) -> None:
    """Tests marked ``nodes`` run in `ros_domain`; other tests open no socket."""
    if request.node.get_closest_marker('nodes'):
        request.getfixturevalue('ros_domain')


class NodeProcess:
    """A node as a separate process with its output in a file."""

    def __init__(self, name: str, log: Path, arguments: list[str], forked: bool) -> None:
        self.name = name
        self._log = log
        self.process: ForkedProcess | subprocess.Popen[bytes]
        log.touch()
        if forked:
            self.process = ForkedNode(name, arguments, log)
            return
        with log.open('wb') as output:
            self.process = subprocess.Popen(
                [sys.executable, '-m', 'starcal_ros.entry_points', name, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, 'PYTHONFAULTHANDLER': '1'},
            )

    def said(self) -> str:
        """Return the output so far."""
        return self._log.read_text(errors='replace')

    def wait(self, timeout_s: float = START_S) -> int:
        """Wait for the end of the process; return its exit status.  One that hangs is killed."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            # Python's fault handler answers SIGABRT with the stacks of all threads.
            self.process.send_signal(signal.SIGABRT)
            self.process.wait()
            pytest.fail(f'{self.name} did not end in {timeout_s:.0f} s:\n{self.said()}')

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send a signal and return the exit status, as `wait` does."""
        self.send(number)
        return self.wait()

    def send(self, number: int = signal.SIGINT) -> None:
        """Send a signal if the process still runs."""
        if self.process.poll() is None:
            self.process.send_signal(number)

    def end(self) -> None:
        """Wait for the end of the process; kill it if it does not end."""
        try:
            self.process.wait(START_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@pytest.fixture
def has_failed(request: pytest.FixtureRequest) -> Callable[[], bool]:
    """Whether the test has failed, for the teardown of fixtures."""
    return lambda: request.node.stash.get(FAILED, False)


StartNode = Callable[..., NodeProcess]


@pytest.fixture
def start_node(
    ros_domain: None, tmp_path: Path, has_failed: Callable[[], bool]
) -> Iterator[StartNode]:
    """
    Start node processes by module name; they are stopped at the end of the test.

    Not ``forked``, they start and end with an interpreter of their own.
    """
    started: list[NodeProcess] = []

    def start(
        name: str, *arguments: str, ros: tuple[str, ...] = (), forked: bool = True
    ) -> NodeProcess:
        ros_arguments = ['--ros-args', *ros] if ros else []
        log = tmp_path / f'{name}{len(started)}.log'
        started.append(NodeProcess(name, log, [*arguments, *ros_arguments], forked))
        return started[-1]

    yield start
    failed = has_failed()
    # A node that does not end must not disturb later tests; test_lifecycle tests that nodes end.
    for process in started:
        # Of a failed test the stacks too: Python's fault handler answers SIGABRT with them.
        process.send(signal.SIGABRT if failed else signal.SIGINT)
    for process in started:
        process.end()
        if failed:
            print(f'{process.name}, exit status {process.process.returncode}:\n{process.said()}')


@pytest.fixture
def forked_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers of files from outside are forked from a process that has their imports."""
    monkeypatch.setattr('starcal_ground.mission.ingest.mission_records.ChildProcess', ForkedChild)


@pytest.fixture(scope='session')
def tiny_bag(made_once: MadeOnce) -> Path:
    """Copy of the bag in the repository, with an absolute URL of its camera file."""

    def copy(folder: Path) -> None:
        shutil.copytree(TINY, folder, dirs_exist_ok=True)
        relative = (TINY / 'params.yaml').read_text()
        params = relative.replace('camera.yaml', f'file://{TINY}/camera.yaml')
        assert params != relative
        (folder / 'params.yaml').write_text(params)

    return made_once('tiny', copy)


@pytest.fixture(scope='session')
def few_images(made_once: MadeOnce) -> Path:
    """
    The same bag as it is after three images, which half of the time calibrates.

    For tests of what becomes of bags and of calibrations, not of what is in them.
    """

    def write(folder: Path) -> None:
        from starcal_ground.simulation import scenario, simulated_bag

        few = dataclasses.replace(scenario.scenario('tiny'), image_count=3)
        simulated_bag.write_bag(few, folder / 'tiny')
        params = folder / 'tiny/params.yaml'
        # The folder is renamed once it is whole: the camera is named relative to the parameters.
        text = params.read_text().replace(f'file://{folder.resolve()}/tiny/', '')
        assert 'camera_info_url: camera.yaml' in text
        params.write_text(text)

    return made_once('few', write) / 'tiny'


@pytest.fixture(scope='session')
def tiny_products(made_once: MadeOnce, tiny_bag: Path) -> Path:
    """Products of `starcal calibrate` for that bag; tests must not change them."""

    def calibrate(folder: Path) -> None:
        from starcal_ground.cli.main import main

        params = str(tiny_bag / 'params.yaml')
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(['calibrate', str(tiny_bag), '--params', params, '-o', str(folder)])
        assert (status, err.getvalue()) == (0, ''), err.getvalue()
        assert 'accepted' in out.getvalue()

    return made_once('tiny_products', calibrate)


def _seen(condition: Callable[..., object]) -> str:
    """Values that a condition refers to, shortened; of lists the last element."""
    function = condition.func if isinstance(condition, functools.partial) else condition
    arguments = condition.args if isinstance(condition, functools.partial) else ()
    looked_at = inspect.signature(function).bind(*arguments).arguments
    if inspect.isfunction(function):
        looked_at |= inspect.getclosurevars(function).nonlocals
    for asked in [value for value in looked_at.values() if inspect.isfunction(value)]:
        looked_at |= inspect.getclosurevars(asked).nonlocals
    newest = {
        name: (len(value), value[-1:]) if isinstance(value, list) else value
        for name, value in looked_at.items()
    }
    return ', '.join(f'{name} = {str(value)[:600]}' for name, value in newest.items())


class Client:
    """A rclpy node that waits for conditions instead of sleeping."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('client', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._diagnostics: list[Any] | None = None
        self._statuses: list[Any] | None = None
        self._services: dict[str, Any] = {}

    def until(self, condition: Callable[[], object], timeout_s: float = START_S) -> None:
        """Spin until a condition holds; fail after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline_s, f'timeout with {_seen(condition)}'
            self._executor.spin_once(timeout_sec=0.05)

    def call(
        self,
        kind: Any,
        name: str,
        timeout_s: float = START_S,
        again_s: float = 40.0,
        **fields: Any,
    ) -> Any:
        """
        Call a service; without an answer after some time, call it once more.

        A node may receive a request before discovery of the client; then its answer is lost.  The
        client stays: once it has had an answer, that of a later call is not lost.
        """
        if name not in self._services:
            self._services[name] = self.node.create_client(kind, name)
        self.until(self._services[name].service_is_ready, timeout_s)
        return self.ask(self._services[name], kind.Request(**fields), timeout_s, again_s)

    def ask(
        self, service: Any, request: Any, timeout_s: float = START_S, again_s: float = 40.0
    ) -> Any:
        """Call a service that is ready; without an answer after some time, call it once more."""
        asked = [service.call_async(request)]
        again_s += time.monotonic()

        def is_answered() -> bool:
            if len(asked) == 1 and time.monotonic() > again_s:
                asked.append(service.call_async(request))
            return any(future.done() for future in asked)

        self.until(is_answered, timeout_s)
        return next(future.result() for future in asked if future.done())

    def collect(self, kind: Any, topic: str, qos: Any = 1000) -> list[Any]:
        """Return a list that collects the messages of a topic."""
        found: list[Any] = []
        self.node.create_subscription(kind, topic, found.append, qos)
        return found

    def latched(self, kind: Any, topic: str) -> list[Any]:
        """Return a list that collects the messages of a latched topic."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return self.collect(kind, topic, qos)

    def publisher(self, kind: Any, topic: str, depth: int = 1000) -> Any:
        """Return a publisher with at least one matched subscriber."""
        publisher = self.node.create_publisher(kind, topic, depth)
        self.until(publisher.get_subscription_count)
        return publisher

    def until_listened(self, name: str = 'star_observer', listeners: int = 1) -> None:
        """
        Wait until an observer reports that its observations have subscribers.

        Discovery is not symmetric, and messages of a volatile publisher before the match are lost.
        """
        self.until(lambda: int(self.health(name)[2].get('listeners', 0)) >= listeners)

    def health(self, name: str = 'star_observer') -> tuple[bytes, str, dict[str, str]]:
        """Level, message and values of the latest diagnostics of a node; empty before them."""
        from diagnostic_msgs.msg import DiagnosticArray

        if self._diagnostics is None:
            self._diagnostics = self.collect(DiagnosticArray, '/diagnostics')
        for message in reversed(self._diagnostics):
            for status in message.status:
                if status.name == f'starcal: {name}':
                    pairs = [(value.key, value.value) for value in status.values]
                    assert len(dict(pairs)) == len(pairs), 'a key twice'
                    return status.level, status.message, dict(pairs)
        return b'', '', {}

    def until_value(self, key: str, value: str, name: str = 'star_observer') -> None:
        """Wait for a value in the diagnostics of a node."""
        self.until(lambda: self.health(name)[2].get(key) == value)

    def statuses(self) -> list[Any]:
        """Return a list that collects what a calibrator reports of its images."""
        if self._statuses is None:
            from starcal.msg import EnsembleStatus

            self._statuses = self.latched(EnsembleStatus, 'ensemble_status')
        return self._statuses

    def until_images(self, images: int, key: str = 'images') -> Any:
        """Wait until a calibrator reports so many images; return its status."""
        found = self.statuses()
        self.until(lambda: found and getattr(found[-1], key) == images)
        return found[-1]

    def until_refused(self, *expected: tuple[str, int]) -> None:
        """Wait until a calibrator reports these reasons of refused images and their counts."""
        found = self.statuses()
        self.until(
            lambda: found and [(e.reason, e.count) for e in found[-1].refused] == [*expected]
        )

    def fill(self, images: Sequence[Any]) -> None:
        """Publish observations to a calibrator; wait until it has all of them."""
        from starcal.msg import StarObservations
        from starcal_ros.formats.messages.record_messages import observations_to_message
        from starcal_ros.ros.node import make_message

        publisher = self.publisher(StarObservations, 'observations')
        for image in images:
            publisher.publish(observations_to_message(image, 'camera', make_message))
        self.until_images(len(images))

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def client(ros_domain: None) -> Iterator[Client]:
    """A client node for one test."""
    pytest.importorskip('rclpy')
    pytest.importorskip('starcal.msg')
    one = Client()
    yield one
    one.close()


@pytest.fixture
def other_client(ros_domain: None) -> Iterator[Client]:
    """A second client node; it answers requests only while it is spun."""
    pytest.importorskip('rclpy')
    one = Client()
    yield one
    one.close()


@pytest.fixture(scope='session')
def tiny_observations() -> Any:
    """Simulated observations of scenario tiny, without pixels."""
    synthetic = pytest.importorskip('starcal_ground.simulation.scenario')
    centroids = pytest.importorskip('starcal_ground.simulation.centroids')
    return centroids.true_observations(synthetic.scenario('tiny'))


@pytest.fixture(scope='session')
def camera_yaml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Camera file of the prior of `tiny_campaign`."""
    from tiny_campaign import SCENARIO  # type: ignore[import-not-found]

    from starcal_ground.products import write_camera_info

    path = tmp_path_factory.mktemp('prior') / 'camera.yaml'
    write_camera_info(SCENARIO.prior.camera, path)
    return path
