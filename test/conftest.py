# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Fixtures: a separate ROS domain, node processes, a client; the tool; the small bag."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
import contextlib
import dataclasses
import fcntl
import gc
import io
import os
from pathlib import Path
import shutil
import signal

from forked_process import ForkedChild  # type: ignore[import-not-found]
import hypothesis
import pytest
from starcal_tool import Answer, Starcal  # type: ignore[import-not-found]
from vehicle import Client, NodeProcess, StartNode, Vehicle  # type: ignore[import-not-found]

from starcal_ground.cli.node_processes import free_domain

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

SLOW_S = 5.0  # of processor time: more than a test of one second takes on most machines
FAILED = pytest.StashKey[bool]()  # in the stash of a test
TINY = Path(__file__).parents[1] / 'bags' / 'tiny'
# Files of eight seconds and more, longest first: at the end, one of them would keep one worker
# while the others wait.
LONGEST = (
    *('test_colcon', 'test_bench', 'test_calibrate', 'test_night_sky', 'test_monte_carlo'),
    *('test_problem_temperature', 'test_arguments_output', 'test_first_setup', 'test_campaign'),
    *('test_evidence', 'test_diagnose', 'test_examples', 'test_star_finder'),
    *('test_docs', 'test_problem_mountings', 'test_motion', 'test_deep_catalog', 'test_kills'),
    *('test_worlds', 'test_processes', 'test_search', 'test_tracking', 'test_set_up_mistakes'),
    *('test_lens_models', 'test_object_store', 'test_end_to_end', 'test_unknown_air'),
    *('test_centroiding', 'test_c_camera', 'test_trend_page', 'test_trend', 'test_state'),
    *('test_hostile_state', 'test_ros_tools', 'test_hostile_messages', 'test_plan'),
    *('test_calibrator', 'test_paper', 'test_joining'),
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
    """Folders by name, filled by the first worker that needs one; tests must not change them."""
    base = tmp_path_factory.getbasetemp()
    if 'PYTEST_XDIST_WORKER' in os.environ:
        base = base.parent  # of all workers

    def made(name: str, fill: Callable[[Path], object]) -> Path:
        folder = base / f'once_{name}'
        with folder.with_suffix('.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                folder.mkdir()
                try:
                    fill(folder)
                except BaseException:  # a skipped test too
                    shutil.rmtree(folder)
                    raise
        return folder

    return made


@pytest.fixture(scope='session')
def ros_domain() -> Iterator[None]:
    """Set a ROS domain of this process alone in the environment, for it and its nodes."""
    with pytest.MonkeyPatch.context() as patch, free_domain() as environment:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


@pytest.fixture(autouse=True)
def domain_of_node_tests(request: pytest.FixtureRequest) -> None:
    """Tests marked ``nodes`` run in `ros_domain`; other tests open no socket."""
    if request.node.get_closest_marker('nodes'):
        request.getfixturevalue('ros_domain')


@pytest.fixture
def has_failed(request: pytest.FixtureRequest) -> Callable[[], bool]:
    """Whether the test has failed, for the teardown of fixtures."""
    return lambda: request.node.stash.get(FAILED, False)


@pytest.fixture
def start_node(
    ros_domain: None, tmp_path: Path, has_failed: Callable[[], bool]
) -> Iterator[StartNode]:
    """Start nodes by module name, stopped after the test; ``forked=False``: own interpreters."""
    started: list[NodeProcess] = []

    def start(name: str, *ros: str, forked: bool = True) -> NodeProcess:
        arguments = ['--ros-args', *ros] if ros else []
        log = tmp_path / f'{name}{len(started)}.log'
        started.append(NodeProcess(name, log, arguments, forked))
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
def starcal(capsys: pytest.CaptureFixture[str]) -> Starcal:
    """Run the tool with words of a command line; the answer has what it prints from then on."""
    from starcal_ground.cli.main import main

    def run(*words: object) -> Answer:
        capsys.readouterr()
        try:
            status = main([str(word) for word in words])
        except SystemExit as ended:  # argparse's way out
            status = int(str(ended.code or 0))
        return Answer(status, *capsys.readouterr())

    return run


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
    """The first three images of that bag: faster, for tests that do not depend on its content."""

    def write(folder: Path) -> None:
        from starcal_ground.simulation import scenario, simulated_bag

        few = dataclasses.replace(scenario.scenario('tiny'), image_count=3)
        simulated_bag.write_bag(few, folder / 'tiny')
        params = folder / 'tiny/params.yaml'
        # Tests copy it: the camera is named relative to the parameters.
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


@pytest.fixture(scope='session')
def tiny(tiny_products: Path) -> object:
    """The calibration among them, with a real covariance."""
    from starcal_ros.formats.products.product_files import read_calibration

    return read_calibration(tiny_products / 'calibration.json')


@pytest.fixture
def client(ros_domain: None) -> Iterator[Client]:
    """A client node for one test."""
    pytest.importorskip('rclpy')
    pytest.importorskip('starcal.msg')
    with contextlib.closing(Client()) as one:
        yield one


@pytest.fixture
def vehicle(start_node: StartNode, tiny_bag: Path) -> Iterator[Vehicle]:
    """A client of the nodes that it starts, for one test."""
    with contextlib.closing(Vehicle(start_node, tiny_bag)) as one:
        yield one


@pytest.fixture(scope='session')
def camera_yaml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Camera file of the prior of `tiny_campaign`."""
    from tiny_campaign import SCENARIO  # type: ignore[import-not-found]

    from starcal_ground.products import write_camera_info

    path = tmp_path_factory.mktemp('prior') / 'camera.yaml'
    write_camera_info(SCENARIO.prior.camera, path)
    return path
