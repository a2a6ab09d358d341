"""Publishers and subscriptions with overridable QoS, whose mismatches are remembered by topic."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.event_handler import (
    PublisherEventCallbacks,
    SubscriptionEventCallbacks,
    UnsupportedEventTypeError,
)
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSPolicyKind, QoSProfile, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions

from dyfn_ros.node.followed import FollowedTopic, LatchedTopic

OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
_OVERRIDES = "qos_overrides."
_OF_RCLPY = ("/clock", "/diagnostics", "/parameter_events", "/rosout")


@dataclass(frozen=True)
class DepthNames:
    """Topics that belong to a depth image: its compressed form, and its camera_info."""

    compressed: str
    info: str


class NodeTopics:
    """Makes a node's topics and destroys them together."""

    def __init__(self, node: LifecycleNode, warn: Callable[[str], None]) -> None:
        self._node, self._warn = node, warn
        self._publishers: list[Any] = []
        self._subscriptions: list[Any] = []
        self._followed: list[FollowedTopic | LatchedTopic] = []
        self._mismatches: dict[str, str] = {}
        self._overridable: set[str] = set()
        self._lock = threading.Lock()

    @property
    def mismatches(self) -> dict[str, str]:
        """By topic: whom it cannot be connected with, and by which policy."""
        with self._lock:
            return dict(self._mismatches)

    def depth_names(self, image: str, info: str, inputs: Collection[str]) -> DepthNames:
        """What goes along when a depth image is remapped, as image_transport has it.

        camera_info is beside the image; below it where the node has a topic of that name already.
        Either name may be remapped on its own. image, info: names before remapping. inputs: topics
        that the node subscribes, resolved.
        """
        resolve = self._node.resolve_topic_name
        topic = resolve(image)
        compressed = resolve(f"{image}/compressedDepth")
        found = resolve(info)
        if topic != self._unmapped(image):
            if compressed == self._unmapped(f"{image}/compressedDepth"):
                compressed = f"{topic}/compressedDepth"
            if found == self._unmapped(info):
                found = f"{topic.rpartition('/')[0]}/camera_info"
                if found in inputs or found in (one.topic_name for one in self._publishers):
                    self._warn(
                        f"the camera_info of {topic} is {topic}/camera_info: {found} is another's"
                    )
                    found = f"{topic}/camera_info"
        return DepthNames(compressed, found)

    def _unmapped(self, name: str) -> str:
        return f"{self._node.get_fully_qualified_name()}{name.removeprefix('~')}"

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
            qos_overriding_options=self._overriding(name, "publisher"),
        )
        self._publishers.append(publisher)
        return publisher

    def subscription(
        self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> Any:
        """topic: resolved by the node, remappings applied."""
        subscription = self._subscribe(kind, topic, callback, None, qos)
        self._subscriptions.append(subscription)
        return subscription

    def follow(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        follow: bool,
        lost: Callable[[int], None],
    ) -> FollowedTopic:
        """follow: the reliability is what the publishers offer, unless it is overridden. lost:
        told how many messages more were sent and did not come, if the middleware knows."""
        name = self._node.resolve_topic_name(topic)
        given = self._given(name, "subscription", [QoSPolicyKind.RELIABILITY])

        def subscribe(take: Callable[[Any, Any], None], qos: QoSProfile) -> Any:
            return self._subscribe(kind, topic, take, lost, qos)

        followed = FollowedTopic(
            self._node, name, qos, subscribe, callback, follow=follow and not given
        )
        self._followed.append(followed)
        return followed

    def check_publishers(self) -> None:
        """Let the followed topics follow. Executor's thread."""
        for followed in self._followed:
            followed.check()

    def latched(self, kind: type, topic: str, callback: Callable[[Any], None]) -> LatchedTopic:
        """A second subscription of a topic, for publishers that keep their last message."""
        name = self._node.resolve_topic_name(topic)
        latched = LatchedTopic(self._node, name, kind, callback)
        self._followed.append(latched)
        return latched

    def _subscribe(
        self,
        kind: type,
        topic: str,
        callback: Callable[..., None],
        lost: Callable[[int], None] | None,
        qos: QoSProfile,
    ) -> Any:
        name = self._node.resolve_topic_name(topic)

        def count_lost(event: Any) -> None:
            if lost is not None:
                lost(event.total_count_change)

        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._mismatch(name, "a publisher", event),
            message_lost=count_lost,
        )
        options = self._overriding(name, "subscription")
        make = partial(
            self._node.create_subscription, kind, topic, callback, qos_overriding_options=options
        )
        try:
            return make(qos, event_callbacks=events)
        except UnsupportedEventTypeError:  # a middleware that does not count what is lost
            events.message_lost = None
            return make(qos, event_callbacks=events)

    # Overrides of QoS, given at start.

    def _overriding(self, topic: str, entity: str) -> QoSOverridingOptions:
        """The policies that are given: rclpy declares a parameter for each, and keeps its value,
        which must not outlive what the node's own parameters say."""
        return QoSOverridingOptions(self._given(topic, entity, OVERRIDABLE))

    def _given(
        self, topic: str, entity: str, policies: Sequence[QoSPolicyKind]
    ) -> list[QoSPolicyKind]:
        names = {f"{_OVERRIDES}{topic}.{entity}.{one.name.lower()}": one for one in policies}
        with self._lock:
            self._overridable.update(names)
        return [one for name, one in names.items() if name in self._node._parameter_overrides]

    def unused_overrides(self) -> list[str]:
        """Overrides that were given for no topic, or no policy, that there is."""
        given = [one for one in self._node._parameter_overrides if one.startswith(_OVERRIDES)]
        with self._lock:
            return [
                name
                for name in given
                if name not in self._overridable
                and name.removeprefix(_OVERRIDES).partition(".")[0] not in _OF_RCLPY
            ]

    def _mismatch(self, topic: str, other: str, event: Any) -> None:
        for followed in self._followed:
            if followed.topic == topic and followed.check():
                return  # there is another subscription now, which fits
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
        for followed in self._followed:
            followed.close()
        self._publishers, self._subscriptions, self._followed = [], [], []
