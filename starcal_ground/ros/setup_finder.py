# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Setup finder node: why images match no star, and the alignment where none is given.

For the integration of a camera, beside a star observer; it does not fly.  The images are searched
in a process of its own at the lowest priority.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
import os
import sys
import threading
from typing import Any

from geometry_msgs.msg import PoseStamped, QuaternionStamped, TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Imu
from sensor_msgs.msg import Image as ImageMessage

from starcal.msg import SetupDiagnosis
from starcal.msg import StarObservations as ObservationsMessage
from starcal_ground.child_process import ChildProcess
from starcal_ground.diagnosis.attitude_readings import wire_attitudes, WireAttitudes
from starcal_ground.diagnosis.diagnose import (
    diagnose,
    Diagnosis,
    found_alignment,
    IMAGES_OF_AN_ALIGNMENT,
)
from starcal_ros.formats.messages import message_codec, sensor_messages
from starcal_ros.pipeline import setup
from starcal_ros.pipeline.detector_frames import NO_FRAMES
from starcal_ros.records import Image
from starcal_ros.ros.inputs import LATCHED
from starcal_ros.ros.node import Health, make_message, OK, run, StarcalNode, WARN
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory

NAME = 'setup_finder'
_IMAGES = QoSProfile(depth=20)  # as in the star observer, so that both see the same
_SAMPLES = QoSProfile(depth=2000)  # ten seconds of a fast star tracker
_HISTORY_S, _JUMP_S = 3600.0, 10.0  # attitudes kept, and steps of the clock, as in star_observer
_KEPT = 5  # images that are searched: of 5 megapixels and 16 bit they are 50 MB
_UNANSWERED = 20  # images whose observations may come later
_IN_A_ROW = 5  # images without a match: fewer may be clouds, a bright body or a slew
_LOWEST_PRIORITY = 19


class SetupFinder(StarcalNode):
    """
    Searches the sky for images that match nothing, and says what of the set-up is wrong.

    After five in a row, then ten, twenty and so on; without a prior alignment after each image
    from the third on, until the alignment is found.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._to_close: list[Callable[[], None]] = []  # by `deactivate`

    def configure(self) -> None:
        """Load the prior camera and the catalog, create the publisher."""
        self._setup = setup.load_setup(self.options.values())
        self._diagnoses = self.publisher(SetupDiagnosis, 'setup_diagnosis', LATCHED)

    def activate(self) -> None:
        """Subscribe to images, attitudes and observations."""
        jump_s = max(_JUMP_S, self._setup.attitude.max_attitude_gap_s)
        self._attitudes = AttitudeHistory(_HISTORY_S, jump_s)
        # Images and refusals meet by their stamps: on a busy machine either comes first.
        self._unanswered: deque[Image] = deque(maxlen=_UNANSWERED)
        self._refused_ns: deque[int] = deque(maxlen=_UNANSWERED)
        self._images = 0
        self._unmatched = Unmatched(self._setup, self._attitudes, self.guarded(self._on_answer))
        self._to_close.append(self._unmatched.close)
        one_by_one = MutuallyExclusiveCallbackGroup()
        attitudes = (QuaternionStamped, PoseStamped, TransformStamped, Imu)
        for kinds, topic, callback, qos, is_raw in (
            ((ObservationsMessage,), 'observations', self._on_observations, _IMAGES, False),
            (attitudes, 'attitude', self._on_attitude, _SAMPLES, False),
            ((ImageMessage, CompressedImage), 'image', self._on_image, _IMAGES, True),
        ):
            take = self.taking(callback)
            self.inputs.add(kinds, topic, take, qos, adapts=True, raw=is_raw, group=one_by_one)

    def deactivate(self) -> None:
        """Close the inputs, end a search under way."""
        self.inputs.close()
        while self._to_close:
            self._to_close.pop()()

    def health(self) -> Health:
        """Diagnostics: the images seen, and the last diagnosis."""
        why = self._unmatched.diagnosis
        numbers: dict[str, object] = {
            'images': self._images,
            'images_without_match': self._unmatched.in_a_row,
            'attitudes': len(self._attitudes),
            'diagnosis': 'none' if why is None else why.cause,
        }
        if why is not None:
            return WARN, self._in_words(why), numbers
        if not self._setup.is_aligned:
            return WARN, 'prior_alignment is not given: waiting for images', numbers
        return OK, 'images match' if self._images else 'waiting for images', numbers

    def needed(self) -> list[str]:
        """Return the topics of the images and attitudes."""
        return [self.resolve_topic_name(topic) for topic in ('image', 'attitude')]

    def _on_image(self, raw: message_codec.RawMessage) -> None:
        frames, offset_s = self._setup.frames, self._setup.attitude.stamp_offset_s
        image = sensor_messages.image_of(raw, offset_s, channel=frames.image_channel)
        if not isinstance(image, Image):
            return  # the star observer refuses it, with the reason
        self._images += 1
        if self._setup.is_aligned:
            self._unanswered.append(image)
            self._match_by_stamps()
        elif not self._has_found():
            self._unmatched.add(image)  # no star observer runs without an alignment

    def _has_found(self) -> bool:
        """Return True if the alignment that was not given is found."""
        why = self._unmatched.diagnosis
        return why is not None and found_alignment(why)[0] is not None

    def _on_attitude(self, message: Any) -> None:
        time_ns, quaternion = sensor_messages.attitude_from_message(message)
        direction = self._setup.attitude.attitude_direction
        self._attitudes.add(time_ns, attitude_sample(time_ns, quaternion, direction))

    def _on_observations(self, message: Any) -> None:
        if not message.refusal and self._unmatched.diagnosis is not None:
            self._publish(Diagnosis('none', None, 'Images match again.'))
        if not message.refusal:
            self._unmatched.matched()
        elif message.refusal == 'no_match':
            self._refused_ns.append(message_codec.stamp_ns(message.header.stamp))
            self._match_by_stamps()

    def _match_by_stamps(self) -> None:
        refused_ns = set(self._refused_ns)
        for image in [image for image in self._unanswered if image.time_ns in refused_ns]:
            self._refused_ns.remove(image.time_ns)
            self._unmatched.add(image)
        kept = [image for image in self._unanswered if image.time_ns not in refused_ns]
        self._unanswered = deque(kept, _UNANSWERED)

    def _on_answer(self, diagnosis: Diagnosis) -> None:
        """Publish and log why images match nothing, or the alignment that they show."""
        text = self._in_words(diagnosis)
        if self._has_found():
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)
        self._publish(diagnosis)
        self.publish_health()

    def _in_words(self, diagnosis: Diagnosis) -> str:
        if self._setup.is_aligned:
            return f'no image matches: {diagnosis.in_a_sentence()}'
        values, sentence = found_alignment(diagnosis)
        if values is None:
            return f'prior_alignment is not given, and not found: {sentence}'
        return f'{sentence} Set prior_alignment: {values}'

    def _publish(self, diagnosis: Diagnosis) -> None:
        stamp_ns = self._unmatched.latest_ns
        camera_frame = self._setup.frames.camera_frame
        self._diagnoses.publish(
            make_message(
                'starcal/msg/SetupDiagnosis',
                header=message_codec.make_header(stamp_ns, camera_frame, make_message),
                cause=diagnosis.cause,
                sentence=diagnosis.sentence,
                evidence=list(diagnosis.evidence),
                parameters=list(diagnosis.mend),
            )
        )


class Unmatched:
    """
    The last images that matched no star, and why they did not.

    Safe to use from several threads.

    Parameters
    ----------
    on_answer : callable
        Called with each diagnosis, in the thread that waited for it.

    Attributes
    ----------
    diagnosis : Diagnosis or None
        Why the last images matched nothing; None: not asked yet, or they match again.
    in_a_row : int
        Number of images without a match since the last one with a match.
    latest_ns : int
        Stamp of the last image that matched nothing; 0 for none.
    """

    def __init__(
        self,
        given: setup.Setup,
        attitudes: AttitudeHistory,
        on_answer: Callable[[Diagnosis], None],
    ) -> None:
        self._setup, self._attitudes = given, attitudes
        self._on_answer = on_answer
        self._lock = threading.Lock()
        self._images: deque[Image] = deque(maxlen=_KEPT)
        self.in_a_row = self.latest_ns = 0
        self._next = self._first()
        self._process: ChildProcess | None = None
        self._is_closed = False
        self._thread: threading.Thread | None = None
        self.diagnosis: Diagnosis | None = None

    def _first(self) -> int:
        return _IN_A_ROW if self._setup.is_aligned else IMAGES_OF_AN_ALIGNMENT

    def matched(self) -> None:
        """Forget the diagnosis: an image matched."""
        with self._lock:
            self.in_a_row, self.diagnosis, self._next = 0, None, self._first()

    def add(self, image: Image) -> None:
        """Keep an image that matched nothing, and have it diagnosed if it is time."""
        with self._lock:
            self._images.append(image)
            self.latest_ns = image.time_ns
            self.in_a_row += 1
            busy = self._thread is not None and self._thread.is_alive()
            if busy or self._is_closed or self.in_a_row < self._next:
                return
            self._next = 2 * self.in_a_row if self._setup.is_aligned else self.in_a_row + 1
            question = (
                tuple(self._images),
                wire_attitudes(self._attitudes, self._setup.attitude.attitude_direction),
                replace(self._setup, detector=NO_FRAMES),
            )
            self._thread = threading.Thread(
                target=self._ask, args=question, name='diagnose', daemon=True
            )
            self._thread.start()

    def close(self) -> None:
        """End a diagnosis under way; there is none after it."""
        with self._lock:
            self._is_closed = True
            if self._process is not None:
                self._process.kill()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _ask(self, *question: object) -> None:
        with self._lock:
            if self._is_closed:
                return
            process = self._process = ChildProcess()
        try:
            diagnosis = process.call(_answer, *question)
        except Exception:  # whatever it is, the node goes on
            return
        finally:
            process.end()
        with self._lock:
            if not self.in_a_row:
                return  # images match again
            self.diagnosis = diagnosis
        self._on_answer(diagnosis)


def _answer(images: tuple[Image, ...], attitudes: WireAttitudes, given: setup.Setup) -> Diagnosis:
    """Diagnose in a process of its own."""
    os.nice(_LOWEST_PRIORITY)
    # Without an alignment nothing was measured.
    return diagnose(images, attitudes, given, refused='no_match' if given.is_aligned else '')


def main(args: Sequence[str] | None = None) -> int:
    """Run the setup finder until shutdown; exit status 2 for bad parameters."""
    return run(SetupFinder, NAME, args)


if __name__ == '__main__':
    sys.exit(main())
