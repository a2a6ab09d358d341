"""Publishers and subscriptions with overridable QoS, whose mismatches are remembered by topic."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions


class NodeTopics:
    """Makes a node's topics and destroys them together."""

    def __init__(self, node: LifecycleNode, warn: Callable[[str], None]) -> None:
        self._node, self._warn = node, warn
        self._publishers: list[Any] = []
        self._subscriptions: list[Any] = []
        self._mismatches: dict[str, str] = {}
        self._lock = threading.Lock()

    @property
    def mismatches(self) -> dict[str, str]:
        """By topic: whom it cannot be connected with, and by which policy."""
        with self._lock:
            return dict(self._mismatches)

    def publisher(self, kind: type, topic: str, qos: QoSProfile) -> Any:
        """A lifecycle publisher: silent while the node is inactive."""
        name = self._node.resolve_topic_name(topic)
        events = PublisherEventCallbacks(
            incompatible_qos=lambda event: self._mismatch(name, "a subscriber", event)
        )
        publisher = self._node.create_lifecycle_publisher(
            kind,
            topic,
            qos,
            event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._publishers.append(publisher)
        return publisher

    def subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> Any:
        """topic: resolved by the node, remappings applied."""
        name = self._node.resolve_topic_name(topic)
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._mismatch(name, "a publisher", event)
        )
        subscription = self._node.create_subscription(
            kind,
            topic,
            callback,
            qos,
            event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._subscriptions.append(subscription)
        return subscription

    def _mismatch(self, topic: str, other: str, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        text = f"{event.total_count} x {other} with incompatible QoS ({policy})"
        with self._lock:
            self._mismatches[topic] = text
        self._warn(f"{topic}: {other} has incompatible QoS ({policy}), no messages pass")

    def close(self) -> None:
        """Destroy them all."""
        for publisher in self._publishers:
            self._node.destroy_lifecycle_publisher(publisher)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._publishers, self._subscriptions = [], []
