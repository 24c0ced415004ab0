"""Trials on the processes of this machine, or on a Dask cluster that is there already."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import logging
from multiprocessing import resource_tracker
import os
import signal
import tempfile

import dask
from distributed import as_completed, Client, LocalCluster

from starcal_ros.campaign import Design, Row, run_trial
from starcal_ros.errors import OptionError

LOOPBACK = '127.0.0.1'
_CONNECT_S = 10.0
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
    """
    Rows of all trials of a design, in any order.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0: none, all is done here.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package; then none is started.
    on_trial : callable
        Called after each trial.

    Raises
    ------
    OptionError
        When there is no scheduler at the address.
    """
    if not scheduler and workers == 0:
        rows: list[Row] = []
        for trial in range(design.trials):
            rows += run_trial(design, trial)
            on_trial()
        return rows
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        stack.enter_context(_quiet())
        if scheduler:
            client = stack.enter_context(_client(scheduler))
        else:
            cluster = stack.enter_context(_local_cluster(min(workers, design.trials)))
            client = stack.enter_context(_client(cluster))
        return _gather(client, design, on_trial)


def _gather(client: Client, design: Design, on_trial: Callable[[], None]) -> list[Row]:
    rows: list[Row] = []
    futures = client.map(
        run_trial, [design] * design.trials, range(design.trials), pure=False, retries=2
    )
    done = as_completed(  # type: ignore[no-untyped-call]
        futures, loop=client.loop, with_results=True
    )
    for _, found in done:
        rows += found
        on_trial()
    return rows


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
