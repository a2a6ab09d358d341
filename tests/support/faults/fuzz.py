"""Random messages on every input topic: changed fields, changed bytes, and what is no message."""

from __future__ import annotations

import array
import copy
import inspect
import math
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from rclpy._rclpy_pybind11 import RCLError
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from dyfn_ros.node.node import StreamDepthNode
from tests.support.faults.bench import (
    MEASURED,
    METRES,
    PACKED,
    PATIENCE,
    RAW,
    Bench,
    faulty_bench,
    packed,
    png,
    scene,
    true_depth,
)
from tests.support.faults.camera_infos import true_info
from tests.support.faults.measurements import measurement
from tests.support.odometry import (
    base_pose,
    odometry,
    pose_stamped,
    pose_with_covariance,
    tf_topic,
    transform,
)
from tests.support.probe import stamped
from tests.support.ros_graph import image_message
from tests.support.tf_here import tf_stand_in

ODOMETRY = {  # cameras on a robot, and the type of its poses
    "driven": "Odometry",
    "posed": "PoseStamped",
    "sure": "PoseWithCovarianceStamped",
    "moved": "TransformStamped",
}
BATCH, SMALL_BATCH = 100, 10  # messages under way; a reference has a queue of 20
OF_NUMBERS = (0, 1, -1, 127, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -(2**31))
OF_FLOATS = (0.0, -1.0, math.nan, math.inf, -math.inf, 1e308, 1e-308, 1e38, 65.535, 1e6)
OF_TEXTS = ("", "x", "optical", "/", "\n", "a" * 5000, "ä", "rgb8", "mono16", "32FC1", "nv12")


@dataclass(frozen=True)
class Topic:
    """name: absolute. make: a good message at a stamp in nanoseconds. camera: whose it is.

    queue: messages that the node's subscription keeps; a newer one takes the place of one alone.
    """

    name: str
    make: Callable[[int], Any]
    camera: str
    queue: int = BATCH


@dataclass
class Found:
    """What became of the messages of a topic. seconds: for all of them."""

    sent: int = 0
    received: int = 0
    seconds: float = 0.0
    raised: Counter[str] = field(default_factory=Counter)


def topics() -> list[Topic]:
    """Every topic that the node subscribes."""
    image = scene(0)

    def measure(kind: str) -> Callable[[int], Any]:
        return lambda stamp: stamped(measurement(kind, METRES * true_depth(image)), stamp, "")

    def posed(make: Callable[[float], Any]) -> Callable[[int], Any]:
        return lambda stamp: make(stamp * 1e-9)

    poses: dict[str, Callable[[float], Any]] = {
        "driven": lambda t: odometry(base_pose(t), t),
        "posed": lambda t: pose_stamped(base_pose(t), t),
        "sure": lambda t: pose_with_covariance(base_pose(t), t, np.full(6, 0.01)),
        "moved": lambda t: transform(base_pose(t), t, "odom", "base_link"),
    }
    found = [
        Topic(f"/{RAW}/image", lambda stamp: stamped(image_message(image), stamp), RAW),
        Topic(
            f"/{PACKED}/image/compressed", lambda stamp: stamped(packed(png(image)), stamp), PACKED
        ),
        Topic(f"/{RAW}/camera_info", lambda stamp: stamped(true_info(), stamp), RAW),
    ]
    found += [
        Topic(f"/{c}/reference", measure(kind), c, SMALL_BATCH) for c, kind in MEASURED.items()
    ]
    found += [Topic(f"/{c}/odometry", posed(poses[c]), c) for c in ODOMETRY]
    for name, parent, child in (
        ("/tf", "odom", "base_link"),
        ("/tf_static", "base_link", "optical"),
    ):
        mount = posed(lambda t, p=parent, c=child: tf_topic(transform(base_pose(t), t, p, c)))
        found.append(Topic(name, mount, "driven"))
    found.append(Topic("/clock", clock, RAW, queue=1))
    return found


def clock(stamp: int) -> Clock:
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(stamp, 10**9)
    return message


@contextmanager
def fuzzed_bench(domain: dict[str, str]) -> Iterator[Bench]:
    """A node that subscribes every kind of topic, and works on every picture."""
    cameras = (RAW, PACKED, *MEASURED, *ODOMETRY)
    own = {}
    for camera, kind in ODOMETRY.items():
        values = {
            "metric_source": "odometry",
            "odometry_type": kind,
            "until_metric": "relative",
            "odometry_wait": 0.0,
            "max_gap": 0.0,
        }
        own.update({f"{camera}.{name}": value for name, value in values.items()})
    own.update({"moved.moving_frame": "base_link", "posed.moving_frame": "base_link"})
    with (
        tf_stand_in(),
        faulty_bench(domain, cameras, drop_frames="false", use_sim_time="true", **own) as bench,
    ):
        yield bench


def leaves(message: Any) -> list[tuple[Any, str, str]]:
    """(owner, field, type) of everything in a message that is no message itself."""
    found = []
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        inner = value if isinstance(value, list) else [value]
        nested = [one for one in inner if hasattr(one, "get_fields_and_field_types")]
        for one in nested:
            found += leaves(one)
        if not nested:
            found.append((message, name, kind))
    return found


def whole_number(kind: str, rng: np.random.Generator) -> int:
    """kind: as ROS calls it, "uint32"."""
    limits = np.iinfo(np.uint8 if kind in ("octet", "char") else kind)
    if rng.random() < 0.4:
        return int(rng.choice([limits.min, limits.max, limits.max - 1]))
    return int(rng.integers(0, min(int(limits.max), 70_000)))


def strange(value: Any, kind: str, rng: np.random.Generator) -> Any:
    """Another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return whole_number(kind, rng)
    if isinstance(value, float):
        most = float(np.finfo(np.float32 if kind == "float" else np.float64).max)
        drawn = rng.choice([*OF_FLOATS, rng.normal(0, 5)])
        return float(np.clip(drawn, -most, most)) if np.isfinite(drawn) else float(drawn)
    if isinstance(value, str):
        return str(rng.choice(OF_TEXTS))
    if isinstance(value, np.ndarray):
        changed = value.copy()
        changed[rng.integers(len(changed))] = rng.choice(OF_FLOATS)
        return changed
    if isinstance(value, array.array):
        return array.array(value.typecode, _changed(np.array(value), rng).tobytes())
    return value


def _changed(content: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shorter, or with other values."""
    size = len(content)
    content = content[
        : int(rng.choice([0, min(1, size), size // 2, max(size - 1, 0), size]))
    ].copy()
    if len(content) and rng.random() < 0.7:
        strangers = OF_FLOATS if content.dtype.kind == "f" else rng.integers(0, 100, 10)
        with np.errstate(over="ignore"):
            content[rng.integers(0, len(content), 5)] = rng.choice(strangers, 5)
    return content


def changed_fields(message: Any, rng: np.random.Generator) -> Any:
    """Up to three of them."""
    message = copy.deepcopy(message)
    places = leaves(message)
    for _ in range(int(rng.integers(1, 4))):
        owner, name, kind = places[rng.integers(len(places))]
        setattr(owner, name, strange(getattr(owner, name), kind, rng))
    return message


def changed_bytes(message: Any, rng: np.random.Generator) -> bytes:
    """As they are on the wire: flipped, cut, longer, or random after the first four."""
    data = bytearray(serialize_message(message))
    kind = rng.integers(4)
    if kind == 0:
        for place in rng.integers(4, min(len(data), 300), int(rng.integers(1, 6))):
            data[place] = int(rng.integers(0, 256))
    elif kind == 1:
        del data[int(rng.integers(4, len(data))) :]
    elif kind == 2:
        data += rng.bytes(int(rng.integers(1, 100)))
    else:
        data[4:] = rng.bytes(int(rng.integers(1, 200)))
    return bytes(data)


@dataclass
class Taken:
    """What the node's executor takes, by topic. last: the stamp of the last one."""

    count: Counter[str] = field(default_factory=Counter)
    last: dict[str, tuple[int, int]] = field(default_factory=dict)

    def more(self, topic: str, count: int) -> bool:
        """Whether there are more than so many."""
        return self.count[topic] > count

    def came(self, topic: str, stamp: tuple[int, int]) -> bool:
        """Whether that one is the last of the topic."""
        return self.last.get(topic) == stamp


def stamp_of(message: Any) -> tuple[int, int]:
    stamp = message.clock if isinstance(message, Clock) else message.header.stamp
    return stamp.sec, stamp.nanosec


@contextmanager
def counted() -> Iterator[Taken]:
    """The messages that callbacks of nodes made meanwhile get."""
    taken = Taken()
    create = StreamDepthNode.create_subscription

    def counting(self: Any, kind: Any, topic: str, callback: Any, *rest: Any, **named: Any) -> Any:
        name = self.resolve_topic_name(topic)

        def note(message: Any) -> None:
            taken.count[name] += 1
            taken.last[name] = stamp_of(message)

        def plain(message: Any) -> Any:
            note(message)
            return callback(message)

        def informed(message: Any, info: Any) -> Any:
            note(message)
            return callback(message, info)

        whole = len(inspect.signature(callback).parameters) == 1
        return create(self, kind, topic, plain if whole else informed, *rest, **named)

    with patch.object(StreamDepthNode, "create_subscription", counting):
        yield taken


def fuzz(bench: Bench, topic: Topic, count: int, taken: Taken, seed: int = 0) -> Found:
    """Send so many to the node.

    Raises AssertionError when a message that ROS can read was lost, or a callback of this package
    raised.
    """
    kept, volatile = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
    qos = QoSProfile(depth=1000, durability=kept if topic.name == "/tf_static" else volatile)
    publisher = bench.probe.node.create_publisher(type(topic.make(0)), topic.name, qos)
    bench.probe.wait(publisher.get_subscription_count, PATIENCE)
    start, errors = time.monotonic(), list[Exception]()
    with patch.object(bench.node, "callback_failed", errors.append):
        found = _send_all(bench, topic, publisher, count, taken, seed)
    bench.probe.node.destroy_publisher(publisher)
    found.seconds = time.monotonic() - start
    for error in errors:
        found.raised[type(error).__name__] += 1
        frames = [str(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
        inside = [one for one in frames if "/dyfn_" in one and not one.endswith("executor.py")]
        assert not inside, error
    return found


def _send_all(
    bench: Bench, topic: Topic, publisher: Any, count: int, taken: Taken, seed: int
) -> Found:
    """After every few messages a good one shows that the node has taken those before."""
    rng, found = np.random.default_rng([seed, len(topic.name)]), Found()
    before, good, readable = taken.count[topic.name], 0, 0
    while found.sent < count:
        for _ in range(min(max(topic.queue, SMALL_BATCH), count - found.sent)):
            message, known = topic.make(bench.step(0.01)), taken.count[topic.name]
            whole = rng.random() < 0.6
            message = changed_fields(message, rng) if whole else changed_bytes(message, rng)
            try:
                publisher.publish(message)
            except RCLError:  # bytes that the middleware does not even send
                continue
            found.sent += 1
            readable += whole
            if topic.queue == 1:
                newer = partial(taken.more, topic.name, known)
                bench.probe.spin_until(newer, PATIENCE if whole else 0.003)
        last = topic.make(bench.step(0.01))
        publisher.publish(last)
        good += 1
        bench.probe.wait(partial(taken.came, topic.name, stamp_of(last)), PATIENCE)
    found.received = taken.count[topic.name] - before - good
    assert found.received >= readable, f"{found}, {readable} of them readable"
    return found


def well(bench: Bench, camera: str) -> None:
    """Depth is good again after a reset: right where it is known."""
    assert bench.ask(Trigger, f"{camera}/reset", Trigger.Request()).success
    if camera not in ODOMETRY:
        bench.recover(camera)
        return
    for _ in range(20):
        depth = bench.work(camera, image_message(bench.fresh()))
        if depth is not None and np.isfinite(depth).mean() > 0.9:
            return
    raise AssertionError(f"no depth of {camera}")
