# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parallel tasks, in processes of this machine or on a running Dask cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
import contextlib
import functools
import itertools
import logging
import re
import threading
from typing import Any, TypeVar

from starcal_ros.blas_threads import one_blas_thread
from starcal_ros.child_process import ChildProcess, ProcessEnded
from starcal_ros.errors import OptionError, StarcalError

Item = TypeVar('Item')
Result = TypeVar('Result')
# Submits an item; items submitted at a time; exception of an item whose processes ended.
Tasks = tuple[Callable[[Any], 'Future[Any]'], int, type[Exception]]

_CONNECT_S = 10.0
_TRIES = 3  # of an item whose process ends: the first with others, then at the end, alone
_AHEAD = 8  # items submitted ahead for each thread of a cluster: cancelling 100,000 is slow
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')


def stream_each(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int = 0,
    scheduler: str = '',
) -> Generator[tuple[Item, Result | Exception], None, None]:
    """
    Pairs (item, result) of a function called with each item, in any order, as they come.

    An item is taken when it is submitted, and let go with its result.  The result of an item whose
    function raises, or whose process ends early each time that it is tried, is the exception.
    Raises OptionError when no scheduler answers at the address.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package; then no process is started.
    """
    items = iter(items)
    first = list(itertools.islice(items, 1))
    if not first:
        return  # without a look for the scheduler
    items = itertools.chain(first, items)
    # Here and not in the worker processes: those of a cluster are not ours.
    function = functools.partial(_on_one_thread, function)
    if not scheduler and not workers:
        for item in items:
            try:
                yield item, function(item)
            except Exception as error:
                yield item, error
        return
    if scheduler:
        tasks = _cluster(scheduler, function)
    else:
        tasks = _processes(function, workers)
    with tasks as (submit, ahead, ended):
        yield from _as_completed(submit, ahead, ended, items)


def _as_completed(
    submit: Callable[[Item], Future[Result]],
    ahead: int,
    ended: type[Exception],
    items: Iterator[Item],
) -> Iterator[tuple[Item, Result | Exception]]:
    """Results as they come, with ``ahead`` items submitted at a time."""
    again = deque[tuple[Item, int]]()  # items whose process ended, and how often
    running: dict[Future[Result], tuple[Item, int]] = {}
    while True:
        for item in itertools.islice(items, ahead - len(running)):
            running[submit(item)] = item, 0
        if not running:
            if not again:
                return
            # Alone: where memory is short, the system may have ended the wrong process.
            item, deaths = again.popleft()
            running[submit(item)] = item, deaths
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            (item, deaths), error = running.pop(future), future.exception()
            if not isinstance(error, ended):
                yield item, error if isinstance(error, Exception) else future.result()
            elif deaths + 1 == _TRIES:
                yield item, StarcalError(f'{error}, the last of {_TRIES} times: out of memory?')
            else:
                again.append((item, deaths + 1))


def _on_one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    """Result of a function, which must not depend on the threads of BLAS."""
    with one_blas_thread():
        return function(item)


@contextlib.contextmanager
def _processes(function: Callable[[Item], Result], workers: int) -> Iterator[Tasks]:
    """Tasks in so many processes of this machine, each called from a thread of its own."""
    processes: dict[int, ChildProcess] = {}  # by thread
    stopping = threading.Event()

    def call(item: Item) -> Result:
        thread = threading.get_ident()
        process = processes.get(thread) or processes.setdefault(thread, ChildProcess())
        # After the process is among those that are killed at the end.
        if stopping.is_set():
            raise CancelledError
        try:
            return process.call(function, item)
        except ProcessEnded as error:
            del processes[thread]
            raise ProcessEnded(f'a worker process ended with status {error}') from error

    threads = ThreadPoolExecutor(workers)
    try:
        yield lambda item: threads.submit(call, item), workers, ProcessEnded
    finally:
        stopping.set()
        for process in list(processes.values()):
            process.kill()
        threads.shutdown()
        for process in processes.values():
            process.end()


@contextlib.contextmanager
def _cluster(address: str, function: Callable[[Item], Result]) -> Iterator[Tasks]:
    """Tasks on a running Dask cluster, which tries an item again whose worker ends."""
    import dask
    from distributed import Client, KilledWorker

    # For another scheme Dask prints a traceback after the time-out.
    if not _ADDRESS.fullmatch(address):
        raise OptionError(f'--scheduler: {address}: not tcp://HOST:PORT or tls://HOST:PORT')
    settings = {'logging': {'distributed': 'critical'}}
    with dask.config.set(settings), _quiet():
        try:
            client: Any = Client(  # type: ignore[no-untyped-call]
                address, timeout=_CONNECT_S, set_as_default=False
            )
        except (OSError, ValueError, TypeError) as error:
            raise OptionError(f'--scheduler: {address}: {error}') from error
        with client:
            threads = max(1, sum(client.nthreads().values()))
            executor = client.get_executor(pure=False, retries=2)
            yield functools.partial(executor.submit, function), _AHEAD * threads, KilledWorker


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
