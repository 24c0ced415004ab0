# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Subscriptions of a node, which adapt to incompatible publishers or report them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Profile of a topic whose last message also reaches later subscribers."""


def with_reliability(qos: QoSProfile, reliability: ReliabilityPolicy) -> QoSProfile:
    """Return a copy of a profile of this package, which sets depth, durability and reliability."""
    return QoSProfile(depth=qos.depth, durability=qos.durability, reliability=reliability)


@dataclass
class _Input:
    kind: Any
    topic: str
    callback: Callable[..., None]
    qos: QoSProfile
    adapts: bool
    group: CallbackGroup
    override: QoSOverridingOptions | None
    subscription: Any = None
    lost: int = 0


class Inputs:
    """
    The subscriptions of a node, each in a callback group of its own unless one is given.

    DDS does not connect a reliable subscription to a best-effort publisher. An adaptive
    subscription is created again as best effort if a publisher offers only that; lost messages of
    reliable publishers are then not repeated.  The ROS parameter
    ``qos_overrides.<topic>.subscription.reliability`` fixes the reliability of such a
    subscription. Safe to use from several threads.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._inputs: list[_Input] = []
        self._lock = threading.Lock()

    def add(
        self,
        kind: Any,
        topic: str,
        callback: Callable[..., None],
        qos: QoSProfile,
        *,
        adapts: bool = False,
        group: CallbackGroup | None = None,
    ) -> None:
        """Subscribe to a topic; with ``adapts`` its reliability may fall to best effort."""
        group = group or MutuallyExclusiveCallbackGroup()
        override = _reliability_override(self._node, topic) if adapts else None
        one = _Input(kind, topic, callback, qos, adapts and not override, group, override)
        with self._lock:
            self._subscribe(one)
            self._inputs.append(one)

    def close(self) -> None:
        """Destroy all subscriptions; safe to call twice."""
        with self._lock:
            while self._inputs:
                self._node.destroy_subscription(self._inputs.pop().subscription)

    def names(self) -> list[str]:
        """Names of the topics on the graph, after remapping."""
        with self._lock:
            return sorted(one.subscription.topic_name for one in self._inputs)

    def lost(self) -> dict[str, int]:
        """
        Messages of each topic that the middleware reports as lost, by the name on the graph.

        A publisher that is faster than the network or this node discards messages that were not
        repeated yet.
        """
        with self._lock:
            return {one.subscription.topic_name: one.lost for one in self._inputs}

    def incompatible(self) -> list[str]:
        """
        Adapt to the current publishers; return each topic with lost messages, and the reason.

        Topics have their names on the graph, after remapping.
        """
        with self._lock:
            return [text for one in self._inputs for text in self._check(one)]

    def _check(self, one: _Input) -> list[str]:
        name = one.subscription.topic_name
        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(name)]
        refused = [qos for qos in offers if _mismatch(qos, one.qos)]
        lower = with_reliability(one.qos, ReliabilityPolicy.BEST_EFFORT)
        if one.adapts and not all(_mismatch(qos, lower) for qos in refused):
            one.qos = lower
            self._node.destroy_subscription(one.subscription)
            self._subscribe(one)
            self._node.get_logger().info(f'{name}: received as best effort, as offered')
            refused = [qos for qos in refused if _mismatch(qos, lower)]
        return [f'{name}: {_mismatch(qos, one.qos)}' for qos in refused]

    def _subscribe(self, one: _Input) -> None:
        def count(event: Any) -> None:
            one.lost += event.total_count_change

        one.subscription = self._node.create_subscription(
            one.kind,
            one.topic,
            one.callback,
            one.qos,
            callback_group=one.group,
            qos_overriding_options=one.override,
            # rclpy's own event callback warns of the name before remapping.
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda _event: None, message_lost=count
            ),
        )


def _reliability_override(node: Node, topic: str) -> QoSOverridingOptions | None:
    """
    Options that apply the user's override of the reliability of a subscription.

    Without an override nothing is declared.  Otherwise rclpy would mistake the default for the
    user's choice when an adaptive subscription is created again.
    """
    name = f'qos_overrides.{node.resolve_topic_name(topic)}.subscription.reliability'
    given = name in getattr(node, '_parameter_overrides', {})  # rclpy has no public access to it
    return QoSOverridingOptions([QoSPolicyKind.RELIABILITY]) if given else None


def _mismatch(offered: QoSProfile, asked: QoSProfile) -> str:
    """Why DDS does not connect two profiles, in the words of rclpy; empty: it does."""
    outcome, why = qos_check_compatible(offered, asked)
    is_error = outcome == QoSCompatibility.ERROR
    return why.replace('ERROR: ', '').rstrip(';') if is_error else ''
