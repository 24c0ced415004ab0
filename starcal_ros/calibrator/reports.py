"""
The reports of a calibrator: folders as of ``starcal calibrate``, in its state folder.

``report/`` is of the calibration in force, ``candidate_report/`` of the last that the gate has
refused.  A thread writes what a report is made from; a process of its own makes the page from
it, so that neither a solve nor a message ever waits for a picture, and nothing that goes wrong
there reaches the node but as a sentence.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from dataclasses import dataclass
import os
from pathlib import Path
import shutil
import subprocess
import sys
import threading

from starcal_ros.assessment.residuals import Residuals
from starcal_ros.bag.writer import BagWriter
from starcal_ros.products.calibration_json import CALIBRATION_FILE, write_calibration
from starcal_ros.products.camera_yaml import CAMERA_INFO_FILE, write_camera_info
from starcal_ros.products.files import OBSERVATIONS_FILE, REPORT_FILE, sync_folder
from starcal_ros.products.residuals_npz import RESIDUALS_FILE, write_residuals
from starcal_ros.records import Calibration, StarObservations

IN_FORCE, CANDIDATE = 'report', 'candidate_report'

_NICENESS = 10  # the star observer goes first
_LONGEST_PAGE_S = 600.0  # a page takes seconds; a processor may be slow and a disk hang
_LONGEST_CLOSE_S = 5.0  # a disk that hangs must not hold the node


@dataclass(frozen=True)
class Subject:
    """What a report is about; without residuals and observations its page says so."""

    calibration: Calibration
    residuals: Residuals | None = None
    observations: tuple[StarObservations, ...] = ()


class CalibratorReports:
    """
    Keeps the reports of a state folder, safe to use from several threads.

    One page is made at a time.  A newer subject of the same folder ends the process that is at
    work on the older one.

    Parameters
    ----------
    tell : callable
        Called from a thread of its own with the path of a page, and with why it is not there, in
        one line; empty where it is.

    Attributes
    ----------
    trouble : str
        Why there is no page of what was shown last; empty where there is one.
    """

    def __init__(self, tell: Callable[[Path, str], None]) -> None:
        self.trouble = ''
        self._tell = tell
        # Of all below; never held while a disk or a process is waited for.
        self._lock = threading.Lock()
        self._state_dir: Path | None = None
        self._frame_id = ''
        self._waiting: dict[Path, Subject] = {}  # by folder
        self._at: Path | None = None  # the folder that the thread is at
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[str] | None = None

    def open(self, state_dir: str, frame_id: str) -> None:
        """Take up a state folder that this process holds; '' stands for none and no reports."""
        with self._lock:
            self._state_dir = Path(state_dir) if state_dir else None
            self._frame_id = frame_id
            self.trouble = ''

    def show(self, name: str, subject: Subject) -> None:
        """Have the folder ``name`` show a calibration; returns at once."""
        with self._lock:
            if self._state_dir is None:
                return
            folder = self._state_dir / name
            self._waiting[folder] = subject
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
        """Let go of the state folder: what waits is written yet, but no page is made."""
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
                folder, subject = self._at, self._waiting.pop(self._at)
            try:
                _replace(folder, subject, self._frame_id)
                trouble = self._make_page(folder)
            except Exception as error:  # no report is worth the node
                trouble = ' '.join(str(error).split()) or type(error).__name__
            with self._lock:
                is_wanted = self._is_wanted()
                if is_wanted:
                    self.trouble = trouble
            if is_wanted:
                self._tell(folder / REPORT_FILE, trouble)

    def _make_page(self, folder: Path) -> str:
        """Make the page; returns why there is none."""
        with self._lock:
            if not self._is_wanted():
                return ''
        process = subprocess.Popen(
            [sys.executable, '-m', 'starcal_ros.cli.main', 'report', str(folder)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors='replace',
            start_new_session=True,  # Ctrl-C is the node's to hear
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


def _replace(folder: Path, subject: Subject, frame_id: str) -> None:
    """Put a folder of products, without a page yet, in the place of the one that is there."""
    new, old = (folder.with_name(f'.{folder.name}.{which}') for which in ('new', 'old'))
    _tidy(folder, new, old)
    try:
        new.mkdir()
        _write(new, subject, frame_id)
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
        sync_folder(folder.parent)
    finally:
        _tidy(folder, new, old)


def _tidy(folder: Path, new: Path, old: Path) -> None:
    """Leave the folder alone, the old one where there is no new one."""
    shutil.rmtree(new, ignore_errors=True)
    if old.exists() and not folder.exists():
        old.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def _write(folder: Path, subject: Subject, frame_id: str) -> None:
    write_calibration(subject.calibration, folder / CALIBRATION_FILE)
    write_camera_info(subject.calibration.geometry.camera, folder / CAMERA_INFO_FILE)
    if subject.observations:
        with BagWriter(folder / OBSERVATIONS_FILE) as writer:
            for record in subject.observations:
                writer.write_observations('/observations', record, frame_id)
    if subject.residuals is not None:
        write_residuals(subject.residuals, folder / RESIDUALS_FILE)
