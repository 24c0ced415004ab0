# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parallel trials, in processes of this machine or on a running Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import functools
import itertools
import logging
import os
import pickle
import queue
import re
import signal
import subprocess
import sys
import threading
from types import FrameType
from typing import Any, TYPE_CHECKING, TypeVar

from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.safe_path import module_command
from starcal_ros.studies.monte_carlo import Design, Row, run_trial

if TYPE_CHECKING:
    from distributed import Client, Future

Result = TypeVar('Result')
Process = subprocess.Popen[bytes]

_CONNECT_S = 10.0
_POLL_S = 0.2  # interval of checks for an interrupt
_AHEAD = 8  # trials submitted ahead for each worker thread of a cluster
_ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')


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
    StarcalError
        When a process ends early.
    """
    if not scheduler and workers == 0:
        results = []
        for number in range(count):
            results.append((number, function(number)))
            on_each()
        return results
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_interrupts_wait())
        if not scheduler:
            return _in_processes(function, count, min(workers, count), on_each, stop)
        import dask

        settings = {'logging': {'distributed': 'critical'}}
        stack.enter_context(dask.config.set(settings))
        stack.enter_context(_quiet())
        client = stack.enter_context(_client(scheduler))
        return _gather(client, function, count, on_each, stop)


def _in_processes(
    function: Callable[[int], Result],
    count: int,
    workers: int,
    on_each: Callable[[], None],
    stop: threading.Event,
) -> list[tuple[int, Result]]:
    """
    All results, from processes that are reached through their own pipes only.

    No process starts from a copy of this one, whose threads may hold locks, nor listens on a
    socket, where another user could send it code.
    """
    start = pickle.dumps(sys.path) + pickle.dumps(function)
    numbers = iter(range(count))
    taking = threading.Lock()
    answers: queue.SimpleQueue[tuple[int, bool, Any]] = queue.SimpleQueue()

    def converse(process: Process) -> None:
        assert process.stdin is not None and process.stdout is not None  # both are pipes
        number = -1
        try:
            process.stdin.write(start)
            while True:
                with taking:
                    number = next(numbers, -1)
                if number < 0:
                    return
                pickle.dump(number, process.stdin)
                process.stdin.flush()
                answers.put((number, *pickle.load(process.stdout)))
        except (OSError, EOFError, ValueError, pickle.UnpicklingError):
            status = process.wait()
            error = StarcalError(f'a worker process ended with status {status}: out of memory?')
            answers.put((number, False, error))

    results: list[tuple[int, Result]] = []
    with _processes(workers) as processes:
        for process in processes:
            threading.Thread(target=converse, args=(process,), daemon=True).start()
        while len(results) < count:
            if stop.is_set():
                raise KeyboardInterrupt
            with contextlib.suppress(queue.Empty):
                number, success, found = answers.get(timeout=_POLL_S)
                if not success:
                    raise found
                results.append((number, found))
                on_each()
    return results


@contextlib.contextmanager
def _processes(count: int) -> Iterator[list[Process]]:
    """Worker processes, which end here at the latest."""
    started: list[Process] = []
    try:
        for _ in range(count):
            started.append(
                subprocess.Popen(
                    module_command('starcal_ros.studies.worker'),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    env={**os.environ, **_ONE_THREAD},
                )
            )
        yield started
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.wait()
            for pipe in (process.stdin, process.stdout):
                with contextlib.suppress(OSError):  # what was left to write finds no reader
                    pipe.close()  # type: ignore[union-attr]


def _gather(
    client: Client,
    function: Callable[[int], Result],
    count: int,
    on_each: Callable[[], None],
    stop: threading.Event,
) -> list[tuple[int, Result]]:
    """All results; submits few tasks ahead, since cancelling 100,000 of them is slow."""
    results: list[tuple[int, Result]] = []
    finished: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    submitted: dict[Future[Result], int] = {}
    numbers = iter(range(count))

    def submit(most: int) -> None:
        for number in itertools.islice(numbers, most):
            future = client.submit(function, number, pure=False, retries=2)
            submitted[future] = number
            future.add_done_callback(finished.put)  # type: ignore[no-untyped-call]

    threads = client.nthreads()  # type: ignore[no-untyped-call]
    submit(_AHEAD * max(1, sum(threads.values())))
    while submitted:
        if stop.is_set():
            raise KeyboardInterrupt
        with contextlib.suppress(queue.Empty):
            future = finished.get(timeout=_POLL_S)
            results.append((submitted.pop(future), future.result()))
            on_each()
            submit(1)
    return results


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


def _client(address: str) -> Client:
    from distributed import Client

    # Of another scheme Dask prints a traceback after the time-out.
    if not _ADDRESS.fullmatch(address):
        raise OptionError(f'--scheduler: {address}: not tcp://HOST:PORT or tls://HOST:PORT')
    try:
        return Client(  # type: ignore[no-untyped-call]
            address, timeout=_CONNECT_S, set_as_default=False
        )
    except (OSError, ValueError, TypeError) as error:
        raise OptionError(f'--scheduler: {address}: {error}') from error


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
