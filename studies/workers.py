# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calls of a function in processes of this machine, which are reached through their own pipes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import as_completed, ThreadPoolExecutor
import os
import threading
from typing import TypeVar

from starcal_ground.child_process import ChildProcess, ProcessEnded
from starcal_ros.errors import StarcalError
from starcal_ros.processes import one_blas_thread

Item = TypeVar('Item')
Result = TypeVar('Result')


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def run_each(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int = 0,
    on_each: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """
    Results of a function for each item, in the order of the items; each on one thread of BLAS.

    ``workers`` is the number of processes to start; 0 runs in-process.  ``on_each`` is called
    with each result as soon as it is there.  Raises the first exception of the function, and
    StarcalError when a process ends during a call.
    """
    if not workers:
        results: list[Result] = []
        for item in items:
            with one_blas_thread():
                results.append(function(item))
            on_each(results[-1])
        return results
    processes: dict[int, ChildProcess] = {}  # by thread

    def call(item: Item) -> Result:
        thread = threading.get_ident()
        process = processes.get(thread) or processes.setdefault(thread, ChildProcess())
        try:
            return process.call(function, item)
        except ProcessEnded as error:
            raise StarcalError(
                f'a worker process ended with status {error}: out of memory?'
            ) from error

    threads = ThreadPoolExecutor(workers)
    try:
        futures = [threads.submit(call, item) for item in items]
        for future in as_completed(futures):
            on_each(future.result())
        return [future.result() for future in futures]
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for process in list(processes.values()):
            process.kill()
        threads.shutdown()
        for process in processes.values():
            process.end()
