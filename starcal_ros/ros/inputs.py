# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Subscriptions of a node, which adapt to incompatible publishers or report them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, field
import threading
from typing import Any

from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    qos_check_compatible,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind

from starcal_ros.formats.messages.message_codec import RawMessage
from starcal_ros.ros.image_queue import Arrivals

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Profile of a topic whose last message also reaches later subscribers."""


def with_reliability(qos: QoSProfile, reliability: ReliabilityPolicy) -> QoSProfile:
    """Return a copy of a profile of this package, which sets depth, durability and reliability."""
    return QoSProfile(depth=qos.depth, durability=qos.durability, reliability=reliability)


_OWN_IMAGES = '/annotated_image'  # published by a star observer, never by a driver
_NAMED = 2  # topics: a third does not help to find the right one


@dataclass
class _Input:
    kinds: tuple[Any, ...]
    topic: str
    name: str  # topic on the graph, after remapping
    callback: Callable[..., None]
    qos: QoSProfile
    of_driver: bool
    adapts: bool
    group: CallbackGroup
    override: QoSOverridingOptions | None
    raw: bool
    kind: Any = None
    subscription: Any = None
    lost: int = 0
    arrivals: Arrivals = field(default_factory=Arrivals)


class Inputs:
    """
    The subscriptions of a node, each in a callback group of its own unless one is given.

    Of several types of message, the first that a publisher of the topic has is received, and
    before there is one, the first.  DDS does not connect a reliable subscription to a best-effort
    publisher. An adaptive subscription is created again as best effort if a publisher offers only
    that; lost messages of reliable publishers are then not repeated.  The ROS parameter
    ``qos_overrides.<topic>.subscription.reliability`` fixes the reliability of such a
    subscription. Safe to use from several threads.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._inputs: list[_Input] = []
        self._lock = threading.Lock()

    def add(
        self,
        kinds: tuple[Any, ...],
        topic: str,
        callback: Callable[..., None],
        qos: QoSProfile,
        *,
        adapts: bool = False,
        raw: bool = False,
        group: CallbackGroup | None = None,
    ) -> None:
        """
        Subscribe to a topic, whose publishers may send any one of some types of message.

        With ``adapts``, for topics of drivers, its reliability may fall to best effort.  With
        ``raw`` the callback gets a `RawMessage`, also of bytes that are none of a message and that
        rclpy would drop.
        """
        group = group or MutuallyExclusiveCallbackGroup()
        name = self._node.resolve_topic_name(topic)
        override = _reliability_override(self._node, name) if adapts else None
        of_driver, adapts = adapts, adapts and not override
        qos = with_reliability(qos, qos.reliability)  # rclpy writes the override into the profile
        entry = _Input(kinds, topic, name, callback, qos, of_driver, adapts, group, override, raw)
        with self._lock:
            entry.kind = _kind_of(entry, self._node.get_publishers_info_by_topic(name))
            self._subscribe(entry)
            self._inputs.append(entry)

    def close(self) -> None:
        """Destroy all subscriptions; safe to call twice."""
        with self._lock:
            while self._inputs:
                self._node.destroy_subscription(self._inputs.pop().subscription)

    def names(self) -> list[str]:
        """Names of the topics on the graph, after remapping."""
        with self._lock:
            return sorted(entry.name for entry in self._inputs)

    def has_come(self, name: str) -> bool:
        """Return True if an input has had a message."""
        entry = self._named(name)
        return entry is not None and bool(entry.arrivals)

    def ended(self, name: str, least_s: float) -> str:
        """Return why the stream of a driver seems to have ended (`Arrivals`); empty otherwise."""
        entry = self._named(name)
        # Other nodes send when there is news: they have no usual interval.
        return entry.arrivals.ended(least_s) if entry is not None and entry.of_driver else ''

    def _named(self, name: str) -> _Input | None:
        with self._lock:
            return next((entry for entry in self._inputs if entry.name == name), None)

    def elsewhere(self, name: str) -> str:
        """Where messages of an input may be that nobody sends to it; empty: nowhere."""
        entry = self._named(name)
        if entry is None or self._node.count_publishers(name):
            return ''
        # The first type of an input is for nothing else: transforms are no attitudes.
        others = self.published(_type_name(entry.kinds[0]))
        return f'{" and ".join(others[:_NAMED])} has a publisher' if others else ''

    def published(self, type_name: str) -> list[str]:
        """Names of the topics of a type that have a publisher and are no inputs of this node."""
        own = {*self.names()}
        return [
            name
            for name, types in self._node.get_topic_names_and_types()
            if type_name in types
            and name not in own
            and not name.endswith(_OWN_IMAGES)
            and self._node.count_publishers(name)
        ]

    def lost(self) -> dict[str, int]:
        """
        Messages of each topic that the middleware reports as lost, by the name on the graph.

        A publisher that is faster than the network or this node discards messages that were not
        repeated yet.
        """
        with self._lock:
            return {entry.name: entry.lost for entry in self._inputs}

    def incompatible(self) -> list[str]:
        """
        Adapt to the current publishers; return each topic with lost messages, and the reason.

        Topics have their names on the graph, after remapping.
        """
        with self._lock:
            return [text for entry in self._inputs for text in self._check(entry)]

    def _check(self, entry: _Input) -> list[str]:
        name, publishers = entry.name, self._node.get_publishers_info_by_topic(entry.name)
        received = _type_name(kind := _kind_of(entry, publishers))
        if kind is not entry.kind:
            # Subscribed at the next look: a participant of DDS has one type for a topic, and the
            # executor may still use the subscription of the other.
            self._node.destroy_subscription(entry.subscription)
            entry.kind, entry.subscription = kind, None
            self._node.get_logger().info(f'{name}: received as {received}, as sent')
            return []
        if entry.subscription is None:
            with contextlib.suppress(RuntimeError):  # still in use: at the look after this
                self._subscribe(entry)
        offers = [info.qos_profile for info in publishers if info.topic_type == received]
        others = sorted({info.topic_type for info in publishers} - {received})
        refused = [qos for qos in offers if _mismatch(qos, entry.qos)]
        lower = with_reliability(entry.qos, ReliabilityPolicy.BEST_EFFORT)
        if entry.adapts and not all(_mismatch(qos, lower) for qos in refused):
            entry.qos = lower
            self._node.destroy_subscription(entry.subscription)
            self._subscribe(entry)
            self._node.get_logger().info(f'{name}: received as best effort, as offered')
            refused = [qos for qos in refused if _mismatch(qos, lower)]
        return [
            *(f'{name}: a publisher sends {other}, not {received}' for other in others),
            *(f'{name}: {_mismatch(qos, entry.qos)}' for qos in refused),
        ]

    def _subscribe(self, entry: _Input) -> None:
        def count(event: Any) -> None:
            entry.lost += event.total_count_change

        received = _type_name(entry.kind)

        def take(message: Any) -> None:
            entry.arrivals.add()
            if entry.raw:
                now_ns = self._node.get_clock().now().nanoseconds
                message = RawMessage(entry.name, received, now_ns, memoryview(message))
            entry.callback(message)

        entry.subscription = self._node.create_subscription(
            entry.kind,
            entry.topic,
            take,
            entry.qos,
            callback_group=entry.group,
            qos_overriding_options=entry.override,
            raw=entry.raw,
            # Those of rclpy warn of the name before remapping, and each costs every wait time.
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=count, use_default_callbacks=False
            ),
        )


def _kind_of(entry: _Input, publishers: Sequence[Any]) -> Any:
    """The first type of message of an input that a publisher shows; the present one if none."""
    shown = {info.topic_type for info in publishers}
    return next(
        (kind for kind in entry.kinds if _type_name(kind) in shown), entry.kind or entry.kinds[0]
    )


def _type_name(kind: Any) -> str:
    return f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'


def _reliability_override(node: Node, name: str) -> QoSOverridingOptions | None:
    """
    Options that apply the user's override of the reliability of the subscription of a topic.

    Without an override nothing is declared.  Otherwise rclpy would mistake the default for the
    user's choice when an adaptive subscription is created again.
    """
    option = f'qos_overrides.{name}.subscription.reliability'
    given = option in getattr(node, '_parameter_overrides', {})  # rclpy has no public access to it
    return QoSOverridingOptions([QoSPolicyKind.RELIABILITY]) if given else None


def _mismatch(offered: QoSProfile, requested: QoSProfile) -> str:
    """Why DDS does not connect two profiles, in the words of rclpy; empty: it does."""
    outcome, why = qos_check_compatible(offered, requested)
    is_error = outcome == QoSCompatibility.ERROR
    return why.replace('ERROR: ', '').rstrip(';') if is_error else ''
