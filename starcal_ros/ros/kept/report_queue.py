# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Reports of a calibrator: folders with the files of ``starcal calibrate``, in its state folder.

``report/`` is for the active calibration, ``candidate_report/`` for the last one that the gate
refused.  A thread writes the products, and a separate process renders the page from them.
Therefore neither a solve nor a message waits for a picture, and an error in the process reaches
the node only as text.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import os
from pathlib import Path
import shutil
import subprocess
import threading

from starcal_ros.child_process import module_command
from starcal_ros.errors import ArchiveError
from starcal_ros.files import PART, sync_folder
from starcal_ros.formats.products import product_folder
from starcal_ros.formats.products.product_files import REPORT_FILE
from starcal_ros.ros.kept.state import Answer

ACTIVE, CANDIDATE = 'report', 'candidate_report'

_METADATA_OF_0_1 = 'metadata.yaml'  # beside observations.mcap in version 0.1, no longer written
_NICENESS = 10  # the star observer has priority
_LONGEST_PAGE_S = 600.0  # a page takes seconds; a slow processor or a hanging disk takes longer
_LONGEST_CLOSE_S = 5.0  # a disk that hangs must not hold the node


class CalibratorReports:
    """
    Maintains the reports of a state folder, safe to use from several threads.

    One page is rendered at a time.  A newer calibration for the same folder ends the process that
    renders the older one; the page states that residuals or observations are missing.

    Parameters
    ----------
    on_page : callable
        Called from a separate thread with the path of a page and one line with the reason why it
        is missing; the line is empty if the page exists.

    Attributes
    ----------
    trouble : str
        Reason why the last page is missing; empty if it exists.
    """

    def __init__(self, on_page: Callable[[Path, str], None]) -> None:
        self.trouble = ''
        self._on_page = on_page
        # Protects the attributes below; never held while waiting for a disk or a process.
        self._lock = threading.Lock()
        self._state_dir: Path | None = None
        self._frame_id = ''
        self._waiting: dict[Path, Answer] = {}  # by folder
        self._at: Path | None = None  # the folder that the thread works on
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[str] | None = None

    def open(self, state_dir: str, frame_id: str) -> None:
        """Use a state folder that this process has locked; '' for no folder and no reports."""
        with self._lock:
            self._state_dir = Path(state_dir) if state_dir else None
            self._frame_id = frame_id
            self.trouble = ''

    def show(self, name: str, answer: Answer) -> None:
        """Update the folder ``name`` to the calibration of an answer; returns at once."""
        with self._lock:
            if self._state_dir is None:
                return
            folder = self._state_dir / name
            self._waiting[folder] = answer
            if self._at == folder:
                self._kill()
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, daemon=True)
                try:
                    self._thread.start()
                except RuntimeError as error:  # the system has no more threads
                    self._thread = None
                    self.trouble = str(error)

    def close(self) -> None:
        """Release the state folder; waiting products are written, but no page is rendered."""
        with self._lock:
            self._state_dir = None
            self._kill()
            thread = self._thread
        if thread is not None:
            thread.join(_LONGEST_CLOSE_S)

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()

    def _is_wanted(self) -> bool:
        return self._state_dir is not None and self._at not in self._waiting

    def _work(self) -> None:
        while True:
            with self._lock:
                self._at = next(iter(self._waiting), None)
                if self._at is None:
                    self._thread = None
                    return
                folder, answer = self._at, self._waiting.pop(self._at)
            try:
                _replace(folder, answer, self._frame_id)
                trouble = self._make_page(folder)
            except Exception as error:  # an error here must not end the node
                trouble = ' '.join(str(error).split()) or type(error).__name__
            with self._lock:
                is_wanted = self._is_wanted()
                if is_wanted:
                    self.trouble = trouble
            if is_wanted:
                self._on_page(folder / REPORT_FILE, trouble)

    def _make_page(self, folder: Path) -> str:
        """Render the page; returns why it is missing, or an empty text."""
        with self._lock:
            if not self._is_wanted():
                return ''
        process = subprocess.Popen(
            [*module_command('starcal_ros.cli.main'), 'report', str(folder)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors='replace',
            start_new_session=True,  # the node handles Ctrl-C
        )
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
        with self._lock:
            self._process = process
            if not self._is_wanted():
                self._kill()
        try:
            said = process.communicate(timeout=_LONGEST_PAGE_S)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return f'not made within {_LONGEST_PAGE_S:g} s'
        finally:
            with self._lock:
                self._process = None
        if process.returncode < 0:
            return f'ended by signal {-process.returncode}'
        if process.returncode > 0:
            return next(reversed(said.split('\n')[:-1]), f'exit status {process.returncode}')
        return ''


def _replace(folder: Path, answer: Answer, frame_id: str) -> None:
    """
    Replace the folder by one with new products, without a page yet.

    Raises ArchiveError when the folder has files that are not of a report; they are kept.
    """
    foreign = sorted(_names_in(folder) - set(product_folder.PRODUCT_FILES) - {_METADATA_OF_0_1})
    if foreign:
        raise ArchiveError(f'{folder}: holds {foreign[0]}, which is not a file of a report')
    new, old = (folder.with_name(f'.{folder.name}.{which}') for which in ('new', 'old'))
    _tidy(folder, new, old)
    try:
        new.mkdir()
        assert answer.calibration is not None  # no other answer is shown
        product_folder.write_products(answer.calibration, new, answer.residuals)
        if answer.observations:
            product_folder.write_observations(answer.observations, new, frame_id)
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
        sync_folder(folder.parent)
    finally:
        _tidy(folder, new, old)


def _names_in(folder: Path) -> set[str]:
    """Names of the finished files in a folder; none if there is no such folder."""
    if not folder.is_dir():
        return set()
    return {path.name for path in folder.iterdir() if not path.name.endswith(PART)}


def _tidy(folder: Path, new: Path, old: Path) -> None:
    """Remove the temporary folders; restore the old folder if there is no new one."""
    shutil.rmtree(new, ignore_errors=True)
    if old.exists() and not folder.exists():
        old.rename(folder)
    shutil.rmtree(old, ignore_errors=True)
