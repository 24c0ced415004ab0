# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The ensemble and the active calibration of a calibrator, in memory and on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import threading
from typing import TYPE_CHECKING

import numpy as np

from starcal_ros import errors, records
from starcal_ros.assessment.gate import judge, reasons_of
from starcal_ros.assessment.remedies import REMEDIES
from starcal_ros.assessment.requirements import requirement_answers, REQUIREMENTS
from starcal_ros.formats.products import product_files
from starcal_ros.pipeline import solve as solving
from starcal_ros.pipeline.setup import CalibratorOptions, Setup, with_method
from starcal_ros.ros.joining import Collections, HISTORY, joined, Kept
from starcal_ros.text import counted

if TYPE_CHECKING:
    from starcal_ros.ros.archive import Archive


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
    in memory, `trouble` has the cause, `on_trouble` is told each change, and `save` tries again.

    Parameters
    ----------
    now_ns : callable
        The time, read at the moment of an activation: a solve may take minutes.
    """

    def __init__(
        self, now_ns: Callable[[], int], on_trouble: Callable[[str], None] = lambda _: None
    ) -> None:
        self._now_ns, self._on_trouble = now_ns, on_trouble
        self.trouble = ''  # why the last attempt to save failed
        self.damage: tuple[str, ...] = ()  # files found damaged when the folder was read
        # By number: why the gate of today refuses the last calibrations.
        self.withheld: Mapping[int, str] = {}
        self._moved = ''  # a sentence on the records in memory when the folder was opened
        # Guards the fields below; never held during a solve.  Activations change only with both
        # locks held, `_disk` first.
        self._records = threading.Lock()
        self._ensemble = records.Ensemble()
        self._collections = Collections()
        self._details: dict[str, str] = {}  # the last refused image for each reason
        self._history: tuple[records.Activation, ...] = ()
        self._active: records.Activation | None = None  # an entry of the history
        self._disk = threading.Lock()  # guards the archive
        self._archive: Archive | None = None
        self._folder = ''
        self._camera = (0, 0, '', '')  # camera of the records in memory
        self._on_disk = Kept()  # last written

    def open(self, setup: Setup, options: CalibratorOptions) -> None:
        """
        Join the records in memory with those of the state folder; without one, continue with them.

        The later activation is active, and nothing is dropped but by `reset`: images of another
        size in the folder are set aside and counted. Records in memory of another camera (size or
        frames) stay in their folder; where they are in none, they raise OptionError, as does a
        folder of another camera. Raises ArchiveError when the folder, or its key, cannot be used.
        Memory and folder are then as before.

        The last calibration is judged by the gate with the present setup before it is active.
        Where it is refused, the one that a roll-back would return to is judged, and so on; refused
        ones stay on record.
        """
        archive = _archive_of(setup, options) if options.state_dir else None
        with self._disk, self._records:
            try:
                memory, moved = self._memory_of(setup)
                kept = memory
                if archive is not None:
                    folder = Kept(
                        archive.read_ensemble(), archive.read_history(), archive.collections
                    )
                    _check_camera(options.state_dir, folder, archive.frames, setup)
                    folder = replace(folder, ensemble=_of_size(folder.ensemble, archive, setup))
                    kept = joined(folder, memory, archive.last_event)
                    if memory:
                        moved = f'{memory} in memory joined {folder} of {options.state_dir}'
                if not kept.collections.current or (memory and self._folder != options.state_dir):
                    kept = replace(kept, collections=kept.collections.begun())
                ensemble = solving.within_limit(kept.ensemble, setup)
            except Exception:
                if archive is not None:
                    archive.close()
                raise
            self._setup, self._folder, self._archive = setup, options.state_dir, archive
            self._camera = _camera_of(setup)
            self._ensemble, self._history = ensemble, kept.history
            self._collections, self._moved = kept.collections, moved
            self._active, self.withheld = self._accepted_from(
                self._history[-1].event if self._history else 0
            )
            self.damage = tuple(archive.damage) if archive else ()
        self.save()

    def _memory_of(self, setup: Setup) -> tuple[Kept, str]:
        """Return the records in memory that are of the camera of a setup, and where others are."""
        memory = Kept(self._ensemble, self._history, self._collections)
        if self._camera == _camera_of(setup):
            return memory, ''
        nothing = Kept(collections=replace(self._collections, current=()))
        if not memory:
            return nothing, ''
        width, height, *frames = self._camera
        of_camera = f'{memory} are of a camera of {width} x {height}, {" in ".join(frames)}'
        if self._folder and memory == self._on_disk:
            return nothing, f'{of_camera}: they stay in {self._folder}'
        raise errors.OptionError(
            f'camera_info_url, camera_frame: {of_camera}, and not on disk: configure with that '
            'camera and a state_dir that can be written, or start the node again without them'
        )

    def _accepted_from(self, event: int) -> tuple[records.Activation | None, dict[int, str]]:
        """
        The last activation at or before an event that the gate of today accepts.

        With a sentence for each that it refuses, by the number of the calibration.
        """
        refused: dict[int, str] = {}
        for record in self._back_from(event):
            why = refusals_today(record.calibration, self._setup)
            if not why:
                return record, refused
            number = record.calibration.number
            refused[number] = (
                f'calibration {number} is not active, the gate refuses it now: {"; ".join(why)}'
            )
        return None, refused

    def _back_from(self, event: int) -> Iterator[records.Activation]:
        """The activation of an event, and those that roll-backs would return to."""
        by_event = {record.event: record for record in self._history}
        record = by_event.get(event)
        while record is not None:
            yield record
            record = by_event.get(record.before) if record.before < record.event else None

    def _withdrawn(self) -> tuple[str, ...]:
        """Return why calibrations are not active, to which no roll-back would return."""
        active = self._active.event if self._active else 0
        kept = {record.calibration.number for record in self._back_from(active)}
        withdrawn = dict.fromkeys(record.calibration.number for record in self._history)
        rolled_back = 'calibration {} is not active, ~/rollback returned to an earlier one'.format
        return tuple(
            self.withheld.get(number) or rolled_back(number)
            for number in withdrawn
            if number not in kept
        )

    def __str__(self) -> str:
        """Return one line: the state folder, the active calibration and the images."""
        active = self.active
        words = [
            f'state_dir {self._folder or "not given"}',
            f'calibration {active.number} active' if active else 'no calibration active',
            counted(len(self.ensemble.images), 'image'),
            self._moved,
        ]
        return '; '.join(filter(None, words))

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
            self._ensemble, self._collections = records.Ensemble(), self._collections.reset()
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
        """
        Solve, and activate a calibration that the gate accepts, or any with ``force``.

        It is judged against the calibration that is active then, which another request may have
        changed during the solve.
        """
        with self._records:
            ensemble, setup = self._ensemble, self._setup
        try:
            asked = with_method(setup, method, estimate)
            calibration = solving.solve(ensemble, asked, active=self.active)
        except errors.TooFewObservations as error:
            return Answer(False, f'{error}{self._why_refused(ensemble.refused)}')
        except errors.StarcalError as error:
            return Answer(False, str(error))
        with self._disk:
            # Its images and limits are of that setup, and of no other.
            if self._setup is not setup or self._is_cleaned_up:
                return Answer(False, 'not activated: the node was cleaned up meanwhile')
            calibration = solving.judged(calibration, ensemble, asked, self.active)
            if not calibration.accepted and not force:
                refused = f'refused by the gate: {"; ".join(calibration.reasons)}'
                return Answer(False, refused, calibration)
            if not calibration.accepted:
                why = (*calibration.reasons, 'activated by request despite the gate')
                calibration = replace(calibration, reasons=why, forced=True)
            if dry_run:
                return Answer(True, f'would be activated: {summary(calibration)}', calibration)
            before = self._history[-1].event if self._history else 0
            return self._activate(self._next_event(), before, calibration, 'activated')

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
        """Activate the last calibration before the active one that the gate of today accepts."""
        with self._disk:
            if self._is_cleaned_up:
                return Answer(False, 'not activated: the node was cleaned up meanwhile')
            if self._active is None:
                return Answer(False, 'no calibration is active')
            wanted = self._active.before
            earlier, refused = self._accepted_from(wanted)
            if earlier is None:
                kept = ' on record' if wanted else ''
                missing = f'there is no calibration before the active one{kept}'
                return Answer(False, '; '.join(refused.values()) or missing)
            answer = self._activate(
                earlier.calibration.number,
                earlier.before,
                earlier.calibration,
                'activated again',
            )
        return replace(answer, message='; '.join((answer.message, *refused.values())))

    def save(self) -> None:
        """Write the records to disk; returns at once where they are there."""
        with self._disk:
            self._save()

    def _save(self) -> None:
        if self._archive is None:
            return
        with self._records:
            kept = Kept(self._ensemble, self._history, self._collections)
            active, withdrawn = self._active, self._withdrawn()
        trouble = ''
        try:
            self._archive.keep(kept.ensemble, kept.history, kept.collections)
            self._archive.keep_active(active, withdrawn)
            self._on_disk = kept
        except errors.ArchiveError as error:
            trouble = str(error)
        except Exception as error:  # whatever it is, the records are not on disk
            trouble = f'{type(error).__name__}: {" ".join(str(error).split())}'
        if trouble != self.trouble:
            self.trouble = trouble
            self._on_trouble(trouble)

    @property
    def is_unsaved(self) -> bool:
        """True if the last attempt to save failed, or the folder was replaced since."""
        with self._disk:
            return bool(self.trouble or (self._archive and not self._archive.is_in_place()))

    def disk_free_bytes(self) -> int | None:
        """Free space for the state folder; None without one."""
        with self._disk:
            return self._archive.free_bytes() if self._archive else None

    def _next_event(self) -> int:
        last = self._history[-1].event if self._history else 0
        return 1 + max(last, self._archive.last_event if self._archive else 0)

    @property
    def _is_cleaned_up(self) -> bool:
        return bool(self._folder) and self._archive is None

    def _activate(
        self, number: int, before: int, calibration: records.Calibration, done: str
    ) -> Answer:
        """Activate a calibration from now on, and save it before anyone else can activate one."""
        active = replace(calibration, number=number, active_since_ns=self._now_ns())
        if not active.active_since_ns:  # in simulated time before the first message of /clock
            return Answer(False, 'not activated: the ROS clock is 0, as before the first /clock')
        try:
            product_files.check_readable(active)
        except errors.ProductError as error:
            why = f'not activated, nobody could read it: {error}; check the ROS clock'
            return Answer(False, why)
        record = records.Activation(self._next_event(), before, active)
        with self._records:
            self._history = (*self._history, record)[-HISTORY:]
            self._active, self.withheld = record, {}
        self._save()
        answer = self._answer(f'{done}: {summary(active)}')
        return replace(answer, calibration=active, active=True)

    def _answer(self, message: str) -> Answer:
        # First: an answer of a service is cut at its end.
        unsaved = f'not on disk: {self.trouble}; ' if self.trouble else ''
        return Answer(True, unsaved + message)


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
    frames, own = (calibration.child_frame, calibration.parent_frame), _camera_of(setup)[2:]
    if frames != own:
        return (f'it is of {" in ".join(frames)}, the parameters of {" in ".join(own)}',)
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
        overridden = {_limit_of(check) for check in calibration.gate if check.passed is False}
    return reasons_of(check for check in checks if _limit_of(check) not in overridden)


def _limit_of(check: records.GateCheck) -> str:
    """Name of the limit: a change from the active calibration then is one from the prior now."""
    return check.name if check.option in ('', REQUIREMENTS) else check.option


def summary(calibration: records.Calibration) -> str:
    """One line on a calibration."""
    fit = (
        f'{calibration.residual_rms_px:.3f} px rms per axis over {calibration.stars_used} stars'
        f' in {calibration.images_used} images'
    )
    return '; '.join([fit, *requirement_answers(calibration)])


def _camera_of(setup: Setup) -> tuple[int, int, str, str]:
    """Size and frames: cameras with one sensor differ by their frames."""
    camera, frames = setup.prior.camera, setup.frames
    return camera.width, camera.height, frames.camera_frame, frames.star_tracker_frame


def _check_camera(state_dir: str, folder: Kept, frames: tuple[str, str], setup: Setup) -> None:
    """Raise OptionError where a folder, with images of these frames, is of another camera."""
    given = _camera_of(setup)
    calibrations = [record.calibration for record in folder.history]
    sizes = {(one.geometry.camera.width, one.geometry.camera.height) for one in calibrations}
    sizes |= {(one.width, one.height) for one in folder.ensemble.images}
    pairs = (frames, *((one.child_frame, one.parent_frame) for one in calibrations))
    named = {(camera, tracker or given[3]) for camera, tracker in pairs if camera}
    for form, stated, own in (
        ('a camera of {} x {}', sizes, given[:2]),
        ('camera_frame {} in {}', named, given[2:]),
    ):
        if stated and own not in stated:
            raise errors.OptionError(
                f'state_dir: {state_dir} is of {form.format(*min(stated))}, the parameters of '
                f'{form.format(*own)}: choose another folder, or the camera of this one'
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
    frames = setup.frames
    return Archive(Path(options.state_dir), frames.camera_frame, seal, frames.star_tracker_frame)
