"""Subscriptions that fit the publishers there are, and are made again when those change."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


class FollowedTopic:
    """A subscription that is reliable when all publishers of its topic are.

    A best-effort subscription fits every publisher, but loses large messages of reliable ones for
    no need; a reliable one gets nothing of a best-effort publisher. While there is no publisher it
    stays as it is, at first reliable: so no first image of a plain driver is lost, and the
    middleware tells of a best-effort publisher at once.

    topic: resolved. subscribe: makes the subscription. follow: False keeps the reliability of qos.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        qos: QoSProfile,
        subscribe: Callable[[QoSProfile], Any],
        follow: bool = True,
    ) -> None:
        self.topic = topic
        self.reliable: bool = qos.reliability == ReliabilityPolicy.RELIABLE
        self._node, self._qos, self._subscribe, self._follow = node, qos, subscribe, follow
        if follow:
            self.reliable = self._offered() is not False
        self._subscription = self._make()

    def check(self) -> bool:
        """Look at the publishers. -> whether that led to another subscription."""
        offered = self._offered() if self._follow else None
        if offered is None or offered == self.reliable:
            return False
        self.close()
        self.reliable = offered
        self._subscription = self._make()
        return True

    def close(self) -> None:
        """Destroy the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _offered(self) -> bool | None:
        """Whether all publishers are reliable; None: there is none."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        kinds = [info.qos_profile.reliability for info in found]
        return all(kind == ReliabilityPolicy.RELIABLE for kind in kinds) if kinds else None

    def _make(self) -> Any:
        qos = copy.copy(self._qos)
        if self._follow:
            kinds = ReliabilityPolicy
            qos.reliability = kinds.RELIABLE if self.reliable else kinds.BEST_EFFORT
        return self._subscribe(qos)


class LatchedTopic:
    """A second subscription of a topic, while a publisher keeps its last message for latecomers.

    Only a transient-local subscription gets that message, and it fits no volatile publisher.
    """

    def __init__(self, node: Node, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        self.topic = topic
        self._node, self._kind, self._callback = node, kind, callback
        self._subscription: Any = None

    def check(self) -> bool:
        """Look at the publishers. -> whether that led to another subscription."""
        found = self._node.get_publishers_info_by_topic(self.topic)
        profiles = [info.qos_profile for info in found]
        latched = [one for one in profiles if one.durability == DurabilityPolicy.TRANSIENT_LOCAL]
        if self._subscription is not None or not latched:
            return False
        reliable = all(one.reliability == ReliabilityPolicy.RELIABLE for one in latched)
        qos = QoSProfile(
            depth=1,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        )
        self._subscription = self._node.create_subscription(
            self._kind,
            self.topic,
            self._callback,
            qos,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        return True

    def close(self) -> None:
        """Destroy the subscription."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
