# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Bag player node: publishes the messages of an MCAP bag unchanged."""

from __future__ import annotations

from collections.abc import Sequence
import sys
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

from starcal.msg import StarObservations as ObservationsMessage
from starcal_ground.bags import reader
from starcal_ground.bags.player_options import PlayerOptions
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import BagError
from starcal_ros.formats.messages import message_codec
from starcal_ros.options import from_mapping, names_of
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES
from starcal_ros.ros import inputs, node, parameters, printable_log

NAME = 'bag_player'
# A writer ahead of its readers by more than its history loses messages, reliable or not.  Images
# are acknowledged within 10 ms, small messages only with the next heartbeat, after up to 3 s.
_IMAGE_DEPTH, _OTHER_DEPTH = 10, 20_000
_UNACKED = {True: _IMAGE_DEPTH // 2, False: _OTHER_DEPTH // 2}
_IMAGES_AHEAD = 4  # images sent ahead of their observations: a star observer queues twenty
_SMALL_PER_S = 2000.0  # rate that a Python reader sustains beside its other work
_ACK_S = 30.0
_POLL_S = 0.1  # longest time without a look at whether a signal has shut ROS down
# A node is discovered subscription by subscription; messages before a match are lost.
_SETTLED_S, _UNMATCHED_S = 0.5, 5.0
_CLOCK_S = 0.01  # wall-clock period of /clock
_DIAGNOSTICS = '/diagnostics'
_LATCHED_TYPES = (
    message_codec.CALIBRATION_TYPE,
    message_codec.STATUS_TYPE,
    message_codec.CAMERA_INFO_TYPE,
)


class BagPlayer(printable_log.PrintableLog):
    """Publishes the messages of a bag in order, with their stamps, at a given rate."""

    def __init__(self) -> None:
        super().__init__(NAME)
        given = parameters.OptionParameters(self, [PlayerOptions])
        given.check_names(names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES))
        self.own = from_mapping(PlayerOptions, given.values())
        if not self.own.bag:
            raise BagError('bag: path of the bag to play is missing')
        self._topics = self._played()
        # A star observer reads the raw images or the compressed ones.
        self._images = set(
            self._of(message_codec.IMAGE_TYPE) or self._of(message_codec.COMPRESSED_TYPE)
        )
        self._players = {}
        for topic in self._topics:
            offer = _offer(topic, topic.name in self._images)
            kind = node.message_class(topic.type_name)
            self._players[topic.name] = self.create_publisher(kind, topic.name, offer)
        self._clock_publisher = (
            self.create_publisher(Clock, '/clock', QoSProfile(depth=10))
            if self.own.clock
            else None
        )
        self._clock_due_s = 0.0
        self._unacked = dict.fromkeys(self._players, 0)
        self._observed = threading.Condition()
        self._observed_count = 0
        self._told: set[str] = set()
        self._listeners: dict[str, int] = {}  # matched by each star observer, by its diagnostics
        # Observations in the bag itself must not pace the player or count as subscribers.
        kinds = {topic.type_name for topic in self._topics}
        self._paced = bool(self._images) and message_codec.OBSERVATIONS_TYPE not in kinds
        if self._paced:
            self._observations = self.create_subscription(
                ObservationsMessage, 'observations', self._on_observations, QoSProfile(depth=1000)
            )
            self.create_subscription(DiagnosticArray, _DIAGNOSTICS, self._on_diagnostics, 10)

    def _played(self) -> list[reader.Topic]:
        """Topics that ROS can have, of an installed type; of several that of most messages."""
        played: dict[str, reader.Topic] = {}
        for topic in sorted(reader.topics([self.own.bag]), key=lambda topic: -topic.count):
            if self.own.clock and topic.name == '/clock':
                continue  # the player publishes its own
            try:
                node.message_class(topic.type_name)
                self.resolve_topic_name(topic.name)
                why = f'is not {played[topic.name].type_name}' if topic.name in played else ''
            except ImportError:
                why = 'is not installed here'
            except RuntimeError:
                why = 'is on no topic that ROS can have'
            if why:
                self.get_logger().warning(f'{topic.name}: {topic.type_name} {why}: skipped')
            else:
                played[topic.name] = topic
        if not played:
            raise BagError(f'{self.own.bag}: no topic has an installed message type')
        return list(played.values())

    def play(self) -> int:
        """Play the bag; 0 if all subscribers have acknowledged all messages."""
        self._wait_for_subscribers()
        while True:
            self._play_once()
            if not self.own.loop:
                break
        if all(player.wait_for_all_acked(_timeout()) for player in self._players.values()):
            return 0
        self.get_logger().error('a subscriber did not acknowledge all messages')
        return 1

    def _play_once(self) -> None:
        start_s, first_ns = time.monotonic(), None
        sent_images, small_s = 0, time.monotonic()
        with self._observed:
            self._observed_count = 0
        channels = {(topic.name, topic.type_name) for topic in self._topics}
        for raw in reader.read_raw([self.own.bag], channels, self._on_damage):
            if first_ns is None:
                first_ns = raw.log_time_ns
            if self.own.rate:
                since_s = (raw.log_time_ns - first_ns) / NANOSECONDS_PER_SECOND
                self._sleep_until(start_s + since_s / self.own.rate)
            self._tell_time(raw.log_time_ns)
            is_image = raw.topic in self._images
            if is_image:
                self._wait_for_observations(sent_images)
                sent_images += 1
            else:
                small_s = max(small_s + 1.0 / _SMALL_PER_S, time.monotonic() - 0.05)
                self._sleep_until(small_s)
            player = self._players[raw.topic]
            try:
                player.publish(reader.cdr_of_this_version(raw))
            except BagError as error:
                self._on_damage(str(error))
                continue
            self._unacked[raw.topic] += 1
            if self._unacked[raw.topic] >= _UNACKED[is_image]:
                player.wait_for_all_acked(_timeout())
                self._unacked[raw.topic] = 0
            self._check_shutdown()

    def _wait_for_subscribers(self) -> None:
        """Wait until the topics that matter have subscribers and no more come, or the timeout."""
        attitudes = self._of(message_codec.ATTITUDE_TYPE)
        # One topic of the other types holds the attitudes; the rest may have other purposes.
        others = [] if attitudes else self._of(*message_codec.ATTITUDE_TYPES)
        needed = [*self._images, *attitudes] or list(self._players)
        other = self.own.wait_for_topic
        awaits_answers = bool(other) and self._is_observations(other)
        deadline_s = time.monotonic() + self.own.wait_for_subscribers_s

        def is_read(name: str) -> bool:
            matched = self._players[name].get_subscription_count()
            if not (matched and awaits_answers):
                return bool(matched)
            # Other nodes read images too, and may start before the one that observes the stars.
            return bool(set(self._readers(name)) & self._answering())

        def settled_s() -> float:
            """Time without a change after which all subscriptions are taken to be matched."""
            needs = [*needed, *others] if awaits_answers else []
            ends = [(len(self._readers(name)), self._players[name]) for name in needs]
            # The graph lists a subscription before messages reach it, and for a while after the
            # death of its node, when it is never matched.
            is_matched = all(n <= one.get_subscription_count() for n, one in ends)
            is_heard = not awaits_answers or self._are_answers_heard()
            return _SETTLED_S if is_matched and is_heard else _UNMATCHED_S

        before: tuple[list[int], list[str], dict[str, int]] | None = None
        since_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            counts = [player.get_subscription_count() for player in self._players.values()]
            missing = [
                *(name for name in needed if not is_read(name)),
                *([] if not others or any(map(is_read, others)) else [' or '.join(others)]),
                *([other] if other and not self._other_subscribers(other) else []),
            ]
            now = counts, missing, dict(self._listeners)
            if now != before:
                before, since_s = now, now_s
            if not missing and now_s >= since_s + settled_s():
                return
            if now_s > deadline_s:
                if missing:
                    names = ', '.join(missing)
                    self.get_logger().warning(f'no subscriber on {names}: playing anyway')
                return
            self._sleep_until(now_s + 0.02)  # rclpy cannot wait for a match

    def _of(self, *kinds: str) -> list[str]:
        """Topics of the bag of some types."""
        return [topic.name for topic in self._topics if topic.type_name in kinds]

    def _is_observations(self, topic: str) -> bool:
        return self._paced and self.resolve_topic_name(topic) == self._observations.topic_name

    def _other_subscribers(self, topic: str) -> int:
        count = int(self.count_subscribers(self.resolve_topic_name(topic)))
        return count - self._is_observations(topic)

    def _readers(self, topic: str) -> list[tuple[str, str]]:
        """Namespace and name of the node of each subscription to a topic of the bag."""
        (kind,) = (one.type_name for one in self._topics if one.name == topic)
        ends = self.get_subscriptions_info_by_topic(self._players[topic].topic_name)
        return [(end.node_namespace, end.node_name) for end in ends if end.topic_type == kind]

    def _answering(self) -> set[tuple[str, str]]:
        """Nodes that publish observations, each by namespace and name."""
        return self._publishing(self._observations.topic_name)

    def _publishing(self, topic: str) -> set[tuple[str, str]]:
        ends = self.get_publishers_info_by_topic(topic)
        return {(end.node_namespace, end.node_name) for end in ends}

    def _are_answers_heard(self) -> bool:
        """
        Return True if observations reach all their subscribers that the graph shows.

        A star observer may discover the player before the calibrator.  Its diagnostics tell how
        many subscribers it has matched; of a node without diagnostics nobody knows.
        """
        known = self.count_subscribers(self._observations.topic_name)
        reporting = self._answering() & self._publishing(_DIAGNOSTICS)
        names = (f'{namespace.rstrip("/")}/{name}' for namespace, name in reporting)
        return all(self._listeners.get(name, 0) >= known for name in names)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            for one in status.values:
                if one.key == 'listeners' and one.value.isdecimal():
                    self._listeners[status.hardware_id] = int(one.value)

    def _wait_for_observations(self, sent: int) -> None:
        """Wait while a star observer has too many images in its queue."""
        if not self._paced or not self.count_publishers(self._observations.topic_name):
            return
        with self._observed:
            before, since_s = self._observed_count, time.monotonic()
            while sent - self._observed_count >= _IMAGES_AHEAD:
                self._observed.wait(_POLL_S)
                self._check_shutdown()
                if self._observed_count != before:
                    before, since_s = self._observed_count, time.monotonic()
                elif time.monotonic() > since_s + _ACK_S:
                    self.get_logger().warning(
                        'no observations received: images are no longer paced'
                    )
                    self._paced = False
                    return

    def _sleep_until(self, moment_s: float) -> None:
        while True:
            self._check_shutdown()
            left_s = moment_s - time.monotonic()
            if left_s <= 0:
                return
            time.sleep(min(left_s, _POLL_S))

    def _check_shutdown(self) -> None:
        if not self.context.ok() or node.is_overdue():
            raise ExternalShutdownException

    def _tell_time(self, time_ns: int) -> None:
        if self._clock_publisher is None or time.monotonic() < self._clock_due_s:
            return
        self._clock_due_s = time.monotonic() + _CLOCK_S
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, NANOSECONDS_PER_SECOND)
        self._clock_publisher.publish(message)

    def _on_observations(self, _message: Any) -> None:
        with self._observed:
            self._observed_count += 1
            self._observed.notify()

    def _on_damage(self, text: str) -> None:
        """Warn of damage of the bag, each text once."""
        if text not in self._told:
            self._told.add(text)
            self.get_logger().warning(text)


def _offer(topic: reader.Topic, is_image: bool) -> QoSProfile:
    if topic.type_name in _LATCHED_TYPES:
        return inputs.LATCHED
    is_kept = DurabilityPolicy.TRANSIENT_LOCAL if topic.is_latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=_IMAGE_DEPTH if is_image else _OTHER_DEPTH, durability=is_kept)


def _listen(executor: node.Executor) -> None:
    """
    Answer messages until ROS is shut down.

    The thread of rclpy that answers a signal wakes the executors before it shuts ROS down: one
    that is quick to wait again is not woken another time, so no wait is without an end.
    """
    try:
        while executor.context.ok():
            executor.spin_once(timeout_sec=1.0)
    except Exception:
        # A signal may come after the loop has asked: a wait under construction then fails.
        if executor.context.ok():
            raise


def _timeout() -> Duration:
    return Duration(seconds=_ACK_S)


def main(args: Sequence[str] | None = None) -> int:
    """
    Play a bag; exit status 0 if all is acknowledged, 1 if not, 2 for a bad bag or parameter.

    A signal ends it with status 0.
    """
    player: BagPlayer | None = None
    listener: threading.Thread | None = None
    executor: node.Executor | None = None  # destroyed after the end, as in `run`

    def work() -> int:
        nonlocal player, listener, executor
        player = BagPlayer()
        executor = node.Executor(2)  # parameters; observations and diagnostics
        executor.add_node(player)
        listener = threading.Thread(target=_listen, args=[executor])
        listener.start()
        return player.play()

    def end() -> None:
        node.shut_down()
        if listener is not None:
            listener.join()
        node.end_quietly(player)

    return node.until_told_to_end(NAME, args, work, end)


if __name__ == '__main__':
    sys.exit(main())
