# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parallel trials and tasks, in processes of this machine or on a running Dask cluster."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
import contextlib
from dataclasses import dataclass
import functools
import logging
import os
import re
import signal
import threading
from types import FrameType
from typing import Any, TYPE_CHECKING, TypeVar

from starcal_ros.blas_threads import one_blas_thread
from starcal_ros.child_process import ChildProcess, ProcessEnded
from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.studies.monte_carlo import Design, Row, run_trial

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar('Item')
Result = TypeVar('Result')

_CONNECT_S = 10.0
_POLL_S = 0.2  # interval of checks for an interrupt
_TRIES = 3  # of an item whose process ends, the last of them alone
_AHEAD = 8  # trials submitted ahead for each worker thread of a cluster
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

    Raises OptionError when no scheduler answers at the address. Raises StarcalError when the
    processes of a call end early, each time that it is tried.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package; then no process is started.
    on_each : callable
        Called after each result.
    """
    results = []
    with contextlib.closing(stream_each(function, range(count), workers, scheduler)) as found:
        for number, result in found:
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
) -> Generator[tuple[int, Result | Exception], None, None]:
    """
    Pairs (index, result) of a function called with each item, in any order, as they come.

    The result of an item whose function raises, or whose process ends early each time that it is
    tried, is the exception.  ``workers`` and ``scheduler`` as for `run_each`.  Raises OptionError
    when no scheduler answers at the address.
    """
    if not items:
        return
    # Here and not in the worker processes: those of a cluster are not ours.
    function = functools.partial(_on_one_thread, function)
    if not scheduler and workers == 0:
        for number, item in enumerate(items):
            try:
                yield number, function(item)
            except Exception as error:
                yield number, error
        return
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_interrupts_wait())
        if scheduler:
            tasks = stack.enter_context(_cluster(scheduler, function))
        else:
            tasks = stack.enter_context(_processes(function, min(workers, len(items))))
        yield from _as_completed(tasks, items, stop)


def _on_one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    """Result of a function, which must not depend on the threads of BLAS."""
    with one_blas_thread():
        return function(item)


@dataclass(frozen=True)
class _Tasks:
    """
    Submission of items to processes.

    Attributes
    ----------
    submit : callable
        Returns the future of an item.
    ahead : int
        Items submitted at a time: cancelling 100,000 of them is slow.
    ended : type
        Exception of an item whose process ended.
    end_idle : callable
        Ends the processes that have no item.
    """

    submit: Callable[[Any], Future[Any]]
    ahead: int
    ended: type[Exception]
    end_idle: Callable[[], None] = lambda: None


def _as_completed(
    tasks: _Tasks, items: Sequence[Item], stop: threading.Event
) -> Iterator[tuple[int, Any]]:
    """
    Results as they come.

    An item whose process ends is tried again in another and, if that ends too, at the end, alone:
    where memory is short, the system may end the wrong process.
    """
    waiting, last = deque(range(len(items))), deque[int]()
    deaths: Counter[int] = Counter()
    running: dict[Future[Any], int] = {}
    while waiting or last or running:
        if stop.is_set():
            raise KeyboardInterrupt
        if last and not (waiting or running):
            tasks.end_idle()
            waiting.append(last.popleft())
        while waiting and len(running) < tasks.ahead:
            number = waiting.popleft()
            running[tasks.submit(items[number])] = number
        for future in wait(running, _POLL_S, FIRST_COMPLETED).done:
            number, error = running.pop(future), future.exception()
            if not isinstance(error, tasks.ended):
                yield number, future.result() if error is None else error
                continue
            deaths[number] += 1
            if deaths[number] == _TRIES:
                yield number, StarcalError(f'{error}, the last of {_TRIES} times: out of memory?')
            else:
                (last if deaths[number] == _TRIES - 1 else waiting).append(number)


@contextlib.contextmanager
def _processes(function: Callable[[Item], Result], workers: int) -> Iterator[_Tasks]:
    """Tasks in so many processes of this machine, each called from a thread of its own."""
    idle: list[ChildProcess] = []
    busy: set[ChildProcess] = set()
    lock, is_open = threading.Lock(), True

    def call(item: Item) -> Result:
        with lock:
            if not is_open:
                raise CancelledError
            process = idle.pop() if idle else ChildProcess()
            busy.add(process)
        try:
            return process.call(function, item)
        except ProcessEnded as error:
            with lock:
                busy.remove(process)
            raise ProcessEnded(f'a worker process ended with status {error}') from error
        finally:
            with lock:
                if process in busy:
                    busy.remove(process)
                    idle.append(process)

    def end_idle() -> None:
        while idle:
            idle.pop().end()

    threads = ThreadPoolExecutor(workers)
    try:
        yield _Tasks(lambda item: threads.submit(call, item), workers, ProcessEnded, end_idle)
    finally:
        with lock:
            is_open = False
            for process in (*idle, *busy):
                process.kill()
        threads.shutdown()
        end_idle()


@contextlib.contextmanager
def _cluster(address: str, function: Callable[[Item], Result]) -> Iterator[_Tasks]:
    """Tasks on a running Dask cluster."""
    import dask
    from distributed import KilledWorker

    settings = {'logging': {'distributed': 'critical'}}
    with dask.config.set(settings), _quiet(), _client(address) as client:
        threads = sum(client.nthreads().values())
        executor = client.get_executor(pure=False, retries=2)
        submit = functools.partial(executor.submit, function)
        yield _Tasks(submit, _AHEAD * max(1, threads), KilledWorker)


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
