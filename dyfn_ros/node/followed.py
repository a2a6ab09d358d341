"""Subscriptions that fit the publishers there are, and are made again when those change."""

from __future__ import annotations

import copy
import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_OVERLAP = 1.0  # seconds in which a new subscription is known to the publishers
_REMEMBERED = 1000  # messages


class FollowedTopic:
    """A subscription that is reliable when all publishers of its topic are.

    A best-effort subscription fits every publisher, but loses large messages of reliable ones for
    no need; a reliable one gets nothing of a best-effort publisher. While there is no publisher it
    stays as it is, at first reliable: so no first image of a plain driver is lost, and the
    middleware tells of a best-effort publisher at once.

    Another subscription needs a moment until the publishers know it. Until then the former one
    stays, and what comes on both is taken once.

    topic: resolved. subscribe: makes a subscription. callback: takes the messages. follow: False
    keeps the reliability of qos.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        qos: QoSProfile,
        subscribe: Callable[[Callable[[Any, Any], None], QoSProfile], Any],
        callback: Callable[[Any], None],
        follow: bool = True,
    ) -> None:
        self.topic = topic
        self.reliable: bool = qos.reliability == ReliabilityPolicy.RELIABLE
        self._node, self._qos, self._subscribe, self._follow = node, qos, subscribe, follow
        self._callback = callback
        self._former: Any = None
        self._changed = -math.inf  # time.monotonic()
        self._taken: deque[int] = deque(maxlen=_REMEMBERED)
        if follow:
            self.reliable = self._offered() is not False
        self._subscription = self._make()

    def check(self) -> bool:
        """Look at the publishers. -> whether there is another subscription, since lately."""
        if self._former is not None and time.monotonic() - self._changed > _OVERLAP:
            self._end_former()
        offered = self._offered() if self._follow else None
        if offered is None or offered == self.reliable:
            return self._former is not None
        self._end_former()
        self.reliable = offered
        self._former, self._changed = self._subscription, time.monotonic()
        self._subscription = self._make()
        return True

    def close(self) -> None:
        """Destroy the subscription."""
        self._end_former()
        self._node.destroy_subscription(self._subscription)

    def _end_former(self) -> None:
        if self._former is not None:
            self._node.destroy_subscription(self._former)
        self._former = None

    def _take(self, message: Any, info: Any) -> None:
        if time.monotonic() - self._changed < 3 * _OVERLAP:
            sent = info["source_timestamp"]
            if sent in self._taken:
                return
            self._taken.append(sent)
        self._callback(message)

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
        return self._subscribe(self._take, qos)


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
