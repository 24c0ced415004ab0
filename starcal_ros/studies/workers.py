"""Trials on the processes of this machine, or on a Dask cluster that is there already."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import functools
import itertools
import logging
from multiprocessing import resource_tracker
import os
import queue
import signal
import tempfile
import threading
from types import FrameType
from typing import TypeVar

import dask
from distributed import Client, Future, LocalCluster

from starcal_ros.errors import OptionError
from starcal_ros.studies.monte_carlo import Design, Row, run_trial

Result = TypeVar('Result')

LOOPBACK = '127.0.0.1'
_CONNECT_S = 10.0
_GLANCE_S = 0.2  # how often to look whether to stop
_AHEAD = 8  # trials handed out for each thread of the workers
_SETTINGS = {
    'logging': {'distributed': 'critical'},
    'distributed.worker.daemon': True,  # a worker whose parent was killed does not stay
    'distributed.nanny.pre-spawn-environ': {
        'OMP_NUM_THREADS': 1,
        'OPENBLAS_NUM_THREADS': 1,
        'MKL_NUM_THREADS': 1,
    },
}


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0))


def run_trials(
    design: Design,
    workers: int = 0,
    scheduler: str = '',
    on_trial: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Rows of all trials of a design, in any order; see `run_each`."""
    trial = functools.partial(run_trial, design)
    found = run_each(trial, design.trials, workers, scheduler, on_trial)
    return [row for _, rows in found for row in rows]


def run_each(
    function: Callable[[int], Result],
    count: int,
    workers: int = 0,
    scheduler: str = '',
    on_each: Callable[[], None] = lambda: None,
) -> list[tuple[int, Result]]:
    """
    What a function makes of each of 0 to count - 1, with that number, in any order.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0: none, all is done here.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package; then none is started.
    on_each : callable
        Called after each.

    Raises
    ------
    OptionError
        When there is no scheduler at the address.
    """
    if not scheduler and workers == 0:
        results = []
        for number in range(count):
            results.append((number, function(number)))
            on_each()
        return results
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_interrupts_wait())
        stack.enter_context(dask.config.set(_SETTINGS))
        stack.enter_context(_quiet())
        if scheduler:
            client = stack.enter_context(_client(scheduler))
        else:
            cluster = stack.enter_context(_local_cluster(min(workers, count)))
            client = stack.enter_context(_client(cluster))
        return _gather(client, function, count, on_each, stop)


def _gather(
    client: Client,
    function: Callable[[int], Result],
    count: int,
    on_each: Callable[[], None],
    stop: threading.Event,
) -> list[tuple[int, Result]]:
    """All results, a few numbers ahead of the workers: 100,000 would be slow to give up."""
    results: list[tuple[int, Result]] = []
    finished: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    handed_out: dict[Future[Result], int] = {}
    numbers = iter(range(count))

    def hand_out(most: int) -> None:
        for number in itertools.islice(numbers, most):
            future = client.submit(function, number, pure=False, retries=2)
            handed_out[future] = number
            future.add_done_callback(finished.put)  # type: ignore[no-untyped-call]

    threads = client.nthreads()  # type: ignore[no-untyped-call]
    hand_out(_AHEAD * max(1, sum(threads.values())))
    while handed_out:
        if stop.is_set():
            raise KeyboardInterrupt
        with contextlib.suppress(queue.Empty):
            future = finished.get(timeout=_GLANCE_S)
            results.append((handed_out.pop(future), future.result()))
            on_each()
            hand_out(1)
    return results


@contextlib.contextmanager
def _interrupts_wait() -> Iterator[threading.Event]:
    """
    Ctrl-C sets an event; a second one is a `KeyboardInterrupt` at once.

    Raised just anywhere in the client of Dask, the exception can leave a lock behind that its
    closing waits for without end.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            signal.default_int_handler(number, frame)
        stop.set()

    before = signal.signal(signal.SIGINT, note)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _local_cluster(workers: int) -> Iterator[LocalCluster]:
    """Worker processes that only this machine can reach."""
    with tempfile.TemporaryDirectory(prefix='starcal-') as folder:
        with _no_interrupts_for_children():
            cluster = LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host=LOOPBACK,
                dashboard_address=None,
                worker_dashboard_address=None,
                # Without a dashboard too it would take port 8787, or warn that it is taken.
                scheduler_kwargs={'dashboard_address': f'{LOOPBACK}:0'},
                silence_logs=logging.CRITICAL,
                local_directory=folder,
                memory_limit=0,
            )
        with cluster:
            yield cluster


@contextlib.contextmanager
def _no_interrupts_for_children() -> Iterator[None]:
    """
    Processes started within do not hear Ctrl-C; this one hears it afterwards.

    The terminal sends it to all of them, and each would print a traceback.
    """
    # It would let the signal through again when started later.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _client(where: LocalCluster | str) -> Client:
    try:
        return Client(  # type: ignore[no-untyped-call]
            where, timeout=_CONNECT_S, set_as_default=False
        )
    except (OSError, ValueError) as error:
        raise OptionError(f'--scheduler: {where}: {error}') from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing on stderr of a connection that closes while a run ends."""
    logger = logging.getLogger('distributed')
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
