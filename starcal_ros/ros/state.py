# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The ensemble and the active calibration of a calibrator, in memory and on disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import threading
from typing import TYPE_CHECKING

import numpy as np

from starcal_ros import errors, records
from starcal_ros.assessment.gate import judge, reasons_of, REMEDIES, requirement_answers
from starcal_ros.pipeline import solve as solving
from starcal_ros.pipeline.setup import CalibratorOptions, Setup, with_method

if TYPE_CHECKING:
    from starcal_ros.ros.archive import Archive

_HISTORY = 20  # activations kept for roll-back, under 1 MB each


@dataclass(frozen=True)
class Answer:
    """
    Result of a request: ``calibration`` is the solution, where there is one.

    ``active`` states whether it is now the active one.
    """

    success: bool
    message: str
    calibration: records.Calibration | None = None
    active: bool = False


class CalibratorState:
    """
    Ensemble and calibrations of one calibrator, safe to use from several threads.

    Both are frozen records: a solve works on the ensemble it began with while the next grows.
    With a state folder both are on disk before they are published; while the disk fails they are
    in memory, `trouble` has the cause, and `save` tries again.

    Parameters
    ----------
    now_ns : callable
        The time, read at the moment of an activation: a solve may take minutes.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self.trouble = ''  # why the last attempt to save failed
        self.damage: tuple[str, ...] = ()  # files found damaged when the folder was read
        self.withheld: tuple[str, ...] = ()  # why the gate of today refuses the last calibration
        # Guards the fields below; never held during a solve.  Activations change only with both
        # locks held, `_disk` first.
        self._records = threading.Lock()
        self._ensemble = records.Ensemble()
        self._details: dict[str, str] = {}  # of the last image refused for each reason
        self._history: tuple[records.Activation, ...] = ()
        self._active: records.Activation | None = None  # of the history
        self._disk = threading.Lock()  # guards the archive
        self._archive: Archive | None = None
        self._folder = ''
        self._on_disk: tuple[object, ...] = ()  # ensemble and history last written

    def open(self, setup: Setup, options: CalibratorOptions) -> None:
        """
        Read the state folder; without one, continue with the records in memory.

        So too where they are not on disk: activations, resets and images since the folder was last
        written.  Images of another size are set aside and counted.

        The last calibration is judged by the gate with the present setup before it is active.
        Where it is refused, the one that a roll-back would return to is judged, and so on; refused
        ones stay on record. Raises ArchiveError when the folder cannot be used. Raises OptionError
        when all its records are of another camera, or the key cannot be read.
        """
        archive = _archive_of(setup, options) if options.state_dir else None
        with self._disk, self._records:
            ensemble, history = self._ensemble, self._history
            is_on_disk = self._on_disk == (ensemble, history)  # the same records
            try:
                if archive is not None:
                    read = archive.read_ensemble(), archive.read_history()
                    if is_on_disk or self._folder != options.state_dir:
                        ensemble, history = read
                    _check_size(options.state_dir, ensemble, history, setup)
                ensemble = _of_size(ensemble, archive, setup)
                ensemble = solving.within_limit(ensemble, setup)
            except Exception:
                if archive is not None:
                    archive.close()
                raise
            self._setup, self._folder, self._archive = setup, options.state_dir, archive
            self._ensemble, self._history = ensemble, history
            self._choose_active()
            self.damage = tuple(archive.damage) if archive else ()
        self.save()

    def _choose_active(self) -> None:
        """Take the last calibration that the gate of today accepts, and record why not others."""
        by_event = {record.event: record for record in self._history}
        record = self._history[-1] if self._history else None
        withheld = []
        while record is not None:
            refusals = refusals_today(record.calibration, self._setup)
            if not refusals:
                break
            withheld.append(
                f'calibration {record.calibration.number} is not active, the gate refuses it '
                f'now: {"; ".join(refusals)}'
            )
            record = by_event.get(record.before) if record.before < record.event else None
        self._active, self.withheld = record, tuple(withheld)

    def close(self) -> None:
        """Write what is not on disk, release the state folder; safe to call twice."""
        with self._disk:
            self._save()
            if self._archive is not None:
                self._archive.close()
            self._archive = None

    @property
    def ensemble(self) -> records.Ensemble:
        """The images collected."""
        with self._records:
            return self._ensemble

    @property
    def active(self) -> records.Calibration | None:
        """The active calibration."""
        with self._records:
            return self._active.calibration if self._active else None

    @property
    def active_on_disk(self) -> records.Calibration | None:
        """The active calibration, once an activation under way is on disk."""
        with self._disk:
            return self.active

    def add(self, observations: records.StarObservations) -> None:
        """Add one image, or count the reason why it was refused."""
        is_added = False
        while not is_added:
            with self._records:
                ensemble, setup = self._ensemble, self._setup
            grown = solving.add_to_ensemble(ensemble, observations, setup)
            with self._records:  # emptied or opened meanwhile: once more
                if is_added := self._ensemble is ensemble and self._setup is setup:
                    self._ensemble = grown
        if observations.refusal:
            with self._records:
                self._details[records.counted_refusal(observations.refusal)] = observations.detail
        # A camera that sees the Sun for hours must not wear out the disk: counts come with images.
        if grown.images is not ensemble.images:
            self.save()

    def reset(self) -> Answer:
        """Empty the ensemble."""
        with self._records:
            images = len(self._ensemble.images)
            self._ensemble = records.Ensemble()
            self._details.clear()
        self.save()
        return self._answer(f'{images} images dropped; the active calibration stays')

    def status(self) -> records.EnsembleStatus:
        """Images and stars collected, and the predicted precision of a calibration from them."""
        ensemble = self.ensemble
        with self._disk:
            saved = self._archive.saved(ensemble) if self._archive else 0
        status = solving.ensemble_status(ensemble, self._setup)
        return replace(status, images_saved=saved)

    def solve(
        self,
        method: str = '',
        estimate: Sequence[str] = (),
        dry_run: bool = False,
        force: bool = False,
    ) -> Answer:
        """Solve, and activate a calibration that the gate accepts, or any with ``force``."""
        with self._records:
            ensemble, setup = self._ensemble, self._setup
        try:
            asked = with_method(setup, method, estimate)
            calibration = solving.solve(ensemble, asked, active=self.active)
        except errors.TooFewObservations as error:
            return Answer(False, f'{error}{self._why_refused(ensemble.refused)}')
        except errors.StarcalError as error:
            return Answer(False, str(error))
        if not calibration.accepted and not force:
            refused = f'refused by the gate: {"; ".join(calibration.reasons)}'
            return Answer(False, refused, calibration)
        if not calibration.accepted:
            why = (*calibration.reasons, 'activated by request despite the gate')
            calibration = replace(calibration, reasons=why, forced=True)
        if dry_run:
            return Answer(True, f'would be activated: {summary(calibration)}', calibration)
        with self._disk:
            # The gate has judged it with that setup, and with no other.
            if self._setup is not setup or (self._folder and self._archive is None):
                return Answer(False, 'not activated: the node was cleaned up meanwhile')
            before = self._active.event if self._active else 0
            calibration = self._activate(self._next_event(), before, calibration)
        message = self._answer(f'activated: {summary(calibration)}').message
        return Answer(True, message, calibration, True)

    def _why_refused(self, refused: Mapping[str, int]) -> str:
        """Return the most frequent refusal, its last detail and the remedy; empty if none."""
        if not refused:
            return ''
        reason = max(refused, key=lambda name: refused[name])
        with self._records:
            detail = self._details.get(reason, '')
        words = (
            detail.rstrip('.') or records.IMAGE_REFUSALS.get(reason, ''),
            REMEDIES.get(reason, ''),
        )
        return f'; {refused[reason]} images refused as {reason}: {"; ".join(filter(None, words))}'

    def rollback(self) -> Answer:
        """Activate the calibration before the active one again."""
        with self._disk:
            if self._folder and self._archive is None:
                return Answer(False, 'not activated: the node was cleaned up meanwhile')
            if self._active is None:
                return Answer(False, 'no calibration is active')
            wanted = self._active.before
            earlier = [record for record in self._history if record.event == wanted]
            if not earlier:
                kept = ' on record' if wanted else ''
                return Answer(False, f'there is no calibration before the active one{kept}')
            before = earlier[0].calibration
            refusals = refusals_today(before, self._setup)
            if refusals:
                return Answer(
                    False,
                    f'calibration {before.number} is refused by the gate: {"; ".join(refusals)}',
                )
            calibration = self._activate(before.number, earlier[0].before, before)
        answer = self._answer(f'activated again: {summary(calibration)}')
        return replace(answer, calibration=calibration, active=True)

    def save(self) -> None:
        """Write the records to disk; returns at once where they are there."""
        with self._disk:
            self._save()

    def _save(self) -> None:
        if self._archive is None:
            return
        with self._records:
            ensemble, history = self._ensemble, self._history
        try:
            self._archive.keep(ensemble, history)
            self._on_disk, self.trouble = (ensemble, history), ''
        except errors.ArchiveError as error:
            self.trouble = str(error)
        except Exception as error:  # whatever it is, the records are not on disk
            self.trouble = f'{type(error).__name__}: {" ".join(str(error).split())}'

    def disk_free_bytes(self) -> int | None:
        """Free space for the state folder; None without one."""
        with self._disk:
            return self._archive.free_bytes() if self._archive else None

    def _next_event(self) -> int:
        last = self._history[-1].event if self._history else 0
        return 1 + max(last, self._archive.last_event if self._archive else 0)

    def _activate(
        self, number: int, before: int, calibration: records.Calibration
    ) -> records.Calibration:
        """Activate a calibration from now on, and save it before anyone else can activate one."""
        active = replace(calibration, number=number, active_since_ns=self._now_ns())
        record = records.Activation(self._next_event(), before, active)
        with self._records:
            self._history = (*self._history, record)[-_HISTORY:]
            self._active, self.withheld = record, ()
        self._save()
        return active

    def _answer(self, message: str) -> Answer:
        unsaved = f'; not on disk: {self.trouble}' if self.trouble else ''
        return Answer(True, message + unsaved)


def refusals_today(calibration: records.Calibration, setup: Setup) -> tuple[str, ...]:
    """
    Reasons why a stored calibration must not become active, a sentence each; empty if it may.

    The gate judges it with the prior and the limits of the setup, as if none were active.  One
    that was activated despite the gate may fail the checks that it failed then, and no others:
    the request overrode those.
    """
    camera, prior = calibration.geometry.camera, setup.prior.camera
    if (camera.width, camera.height) != (prior.width, prior.height):
        size = f'it is of a camera of {camera.width} x {camera.height}'
        return (f'{size}, the prior camera has {prior.width} x {prior.height}',)
    if not (calibration.accepted or calibration.forced):
        return ('its file states that the gate refused it', *calibration.reasons)
    try:
        with np.errstate(all='ignore'):
            checks = judge(calibration, setup.prior, None, setup.gate, setup.calibration)
    # A file can hold numbers that no solution has, and that an equation cannot take.
    except Exception as error:
        return (f'the gate cannot judge it: {type(error).__name__}: {error}',)
    overridden = set()
    if calibration.forced:
        overridden = {check.name for check in calibration.gate if check.passed is False}
    return reasons_of(check for check in checks if check.name not in overridden)


def summary(calibration: records.Calibration) -> str:
    """One line on a calibration."""
    fit = (
        f'{calibration.residual_rms_px:.3f} px rms per axis over {calibration.stars_used} stars'
        f' in {calibration.images_used} images'
    )
    return '; '.join([fit, *requirement_answers(calibration)])


def _check_size(
    folder: str, ensemble: records.Ensemble, history: tuple[records.Activation, ...], setup: Setup
) -> None:
    """Raise OptionError where every record of a folder is of another camera."""
    prior = setup.prior.camera
    cameras = [record.calibration.geometry.camera for record in history]
    sizes = {(one.width, one.height) for one in cameras}
    sizes |= {(one.width, one.height) for one in ensemble.images}
    if sizes and (prior.width, prior.height) not in sizes:
        width, height = min(sizes)
        raise errors.OptionError(
            f'state_dir: {folder} is of a camera of {width} x {height}, '
            f'the prior camera has {prior.width} x {prior.height}'
        )


def _of_size(
    ensemble: records.Ensemble, archive: Archive | None, setup: Setup
) -> records.Ensemble:
    """The ensemble with images of another size counted as refused, their files set aside."""
    prior, checked = setup.prior.camera, records.Ensemble((), ensemble.refused)
    for image in ensemble.images:
        is_other = (image.width, image.height) != (prior.width, prior.height)
        if is_other and archive is not None:
            archive.set_aside_image(image.time_ns, f'an image of {image.width} x {image.height}')
        checked = checked.add(replace(image, refusal='wrong_size') if is_other else image)
    return checked


def _archive_of(setup: Setup, options: CalibratorOptions) -> Archive:
    """The locked state folder of the options; raises as `CalibratorState.open`."""
    try:
        from starcal_ros.ros.archive import Archive, read_seal
    except ModuleNotFoundError as error:  # rosdep has no key for mcap and rosbags
        raise errors.ArchiveError(
            f'state_dir: {errors.missing_package(error)}, or leave state_dir empty: then a'
            ' restart loses the ensemble'
        ) from error
    seal = read_seal(options.state_key_file)
    return Archive(Path(options.state_dir), setup.frames.camera_frame, seal)
