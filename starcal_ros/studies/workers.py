"""Parallel trials, in processes of this machine or on a running Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from distributed import Client, Future, KilledWorker, LocalCluster

from starcal_ros.errors import OptionError
from starcal_ros.studies.monte_carlo import Design, Row, run_trial

Item = TypeVar('Item')
Result = TypeVar('Result')

LOOPBACK = '127.0.0.1'
_CONNECT_S = 10.0
_POLL_S = 0.2  # interval of checks for an interrupt
_AHEAD = 8  # trials submitted ahead for each worker thread
_SETTINGS = {
    'logging': {'distributed': 'critical'},
    # A task is tried on a second worker process and, if that dies too, once more alone.
    'distributed.scheduler.allowed-failures': 1,
    'distributed.worker.daemon': True,  # a worker ends with its parent
    'distributed.nanny.pre-spawn-environ': {
        'OMP_NUM_THREADS': 1,
        'OPENBLAS_NUM_THREADS': 1,
        'MKL_NUM_THREADS': 1,
    },
}


def processors() -> int:
    """Number of processors that this process may use."""
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
    Pairs (number, result) of a function called with 0 to count - 1, in any order.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package; then no process is started.
    on_each : callable
        Called after each result.

    Raises
    ------
    OptionError
        When no scheduler answers at the address.
    """
    results = []
    for number, result in stream_each(function, range(count), workers, scheduler):
        if isinstance(result, Exception):
            raise result
        results.append((number, result))
        on_each()
    return results


def stream_each(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int = 0,
    scheduler: str = '',
) -> Iterator[tuple[int, Result | Exception]]:
    """
    Pairs (index, result) of a function called with each item, in any order, as they come.

    The result of an item whose function raises, or whose worker process dies again and again, is
    the exception.  ``workers`` and ``scheduler`` as for `run_each`.
    """
    if not items:
        return
    if not scheduler and workers == 0:
        for number, item in enumerate(items):
            try:
                yield number, function(item)
            except Exception as error:
                yield number, error
        return
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_interrupts_wait())
        stack.enter_context(dask.config.set(_SETTINGS))
        stack.enter_context(_quiet())
        if scheduler:
            client = stack.enter_context(_client(scheduler))
        else:
            cluster = stack.enter_context(_local_cluster(min(workers, len(items))))
            client = stack.enter_context(_client(cluster))
        killed = []
        for number, result in _gather(client, function, dict(enumerate(items)), stop):
            if isinstance(result, KilledWorker):
                killed.append(number)
            else:
                yield number, result
        # A task that only waited on a worker that another one killed is blamed too: alone, each
        # shows whether it was the one.
        for number in killed:
            yield from _gather(client, function, {number: items[number]}, stop)


def _gather(
    client: Client,
    function: Callable[[Item], Result],
    items: Mapping[int, Item],
    stop: threading.Event,
) -> Iterator[tuple[int, Result | Exception]]:
    """Results as they come; submits few tasks ahead, since cancelling 100,000 of them is slow."""
    finished: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    submitted: dict[Future[Result], int] = {}
    waiting = iter(items.items())

    def submit(most: int) -> None:
        for number, item in itertools.islice(waiting, most):
            future = client.submit(function, item, pure=False, retries=2)
            submitted[future] = number
            future.add_done_callback(finished.put)  # type: ignore[no-untyped-call]

    threads = client.nthreads()  # type: ignore[no-untyped-call]
    submit(_AHEAD * max(1, sum(threads.values())))
    while submitted:
        if stop.is_set():
            raise KeyboardInterrupt
        with contextlib.suppress(queue.Empty):
            future = finished.get(timeout=_POLL_S)
            number = submitted.pop(future)
            try:
                result: Result | Exception = future.result()
            except Exception as error:
                result = error
            submit(1)
            yield number, result


@contextlib.contextmanager
def _interrupts_wait() -> Iterator[threading.Event]:
    """
    Ctrl-C sets an event; a second one raises `KeyboardInterrupt` at once.

    An exception raised inside the Dask client can leave a lock held, on which closing the client
    would wait forever.
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
                # Otherwise it opens port 8787 even without a dashboard, or warns if it is in use.
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
    Block Ctrl-C in processes started within; this process receives it afterwards.

    The terminal sends it to all processes, and each would print a traceback.
    """
    # Started later, it would unblock the signal.
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
    """Suppress messages about connections that close at the end of a run."""
    logger = logging.getLogger('distributed')
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
