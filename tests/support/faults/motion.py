"""Poses of the robot, transforms and clocks that say what cannot be."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock

from tests.support.faults.bench import PATIENCE, RAW, Bench, faulty_bench
from tests.support.faults.fault import Fault
from tests.support.faults.pictures import HUGE, RIGHT, outcome
from tests.support.odometry import base_pose, odometry, tf_topic, transform
from tests.support.ros_graph import image_message
from tests.support.tf_here import tf_stand_in

DRIVEN, TIED = "driven", "tied"  # with odometry; the place of the second on the robot is by tf
COUNT = 4
Change = Callable[[Odometry], object]


@contextmanager
def motion_bench(domain: dict[str, str]) -> Iterator[Bench]:
    """The camera is where the base is."""
    own = {
        "driven.metric_source": "odometry",
        "driven.until_metric": "relative",
        "driven.odometry_wait": 0.0,
        "driven.camera_pose": "'0 0 0 0 0 0 1'",
        "driven.max_gap": 0.0,
        "tied.metric_source": "odometry",
        "tied.until_metric": "relative",
        "tied.odometry_wait": 0.0,
        "tied.max_gap": 0.0,
    }
    with tf_stand_in(), faulty_bench(domain, (RAW, DRIVEN, TIED), **own) as bench:
        for offset in range(10):  # a drive that goes well
            drive(bench, DRIVEN, offset * 0.1)
        yield bench


def drive(bench: Bench, camera: str, seconds: float, change: Change = lambda one: None) -> Odometry:
    """A pose at the time of the next picture, on the robot's circle."""
    stamp = bench.step() * 1e-9
    message = odometry(base_pose(stamp), stamp)
    change(message)
    bench.probe.publish(f"/{camera}/odometry", message)
    return message


def depth_goes_on(bench: Bench, camera: str) -> str:
    image = bench.fresh()
    found = outcome(bench, bench.work(camera, image_message(image)), image)
    assert found == RIGHT
    return found


def strange_poses(change: Change) -> Callable[[Bench], str]:
    """Between pictures, whose depth stays right."""

    def do(bench: Bench) -> str:
        for _ in range(COUNT):
            drive(bench, DRIVEN, 0.0, change)
            found = depth_goes_on(bench, DRIVEN)
        for _ in range(COUNT):
            drive(bench, DRIVEN, 0.0)
        return found

    return do


def refused(name: str, says: str, change: Change) -> Fault:
    do = strange_poses(change)
    return Fault(f"odometry: {name}", do, (f"WARN /driven/odometry: .*{says}",), True, DRIVEN)


def position(value: float) -> Change:
    def change(message: Odometry) -> None:
        message.pose.pose.position.x = value

    return change


def quaternion(length: float) -> Change:
    def change(message: Odometry) -> None:
        turn = message.pose.pose.orientation
        turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, length

    return change


def covariance(value: float) -> Change:
    def change(message: Odometry) -> None:
        message.pose.covariance = np.full(36, value)

    return change


def framed(message: Odometry) -> None:
    message.header.frame_id, message.child_frame_id = "other", "another"


def stamp_of_zero(message: Odometry) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def bad_stamp(message: Odometry) -> None:
    message.header.stamp.sec, message.header.stamp.nanosec = -5, HUGE


def transforms(*made: Any) -> Callable[[Bench], str]:
    """On /tf, about the other camera's place on the robot; poses come around each picture."""

    def do(bench: Bench) -> str:
        for make in made:
            bench.probe.publish("/tf", tf_topic(make(bench.step() * 1e-9)))
        poses = bench.camera(TIED).odometry.poses
        assert poses is not None
        for _ in range(COUNT):
            image, before, stamp, _ = bench.fresh(), bench.step(), bench.step(), bench.step()
            taken = poses.taken
            for now in (before, bench.now):
                message = odometry(base_pose(now * 1e-9), now * 1e-9)
                bench.probe.publish("/tied/odometry", message)
            bench.probe.wait(lambda taken=taken: poses.taken == taken + 2, PATIENCE)
            found = outcome(bench, bench.work(TIED, image_message(image), stamp), image)
            assert found == RIGHT
        return found

    return do


def tf(parent: str, child: str, x: float = 0.1) -> Callable[[float], Any]:
    def make(seconds: float) -> Any:
        message = transform(base_pose(0), seconds, parent, child)
        message.transform.translation.x = x
        return message

    return make


def unknown(name: str, says: str, *made: Any) -> Fault:
    """The camera's place on the robot is not known; its depth goes on without."""
    return Fault(f"tf: {name}", transforms(*made), (says,), True, camera=TIED)


# The clock.


def clock(bench: Bench, seconds: float) -> None:
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(round(seconds * 1e9), 10**9)
    bench.probe.publish("/clock", message)
    bench.probe.spin_until(
        lambda: abs(bench.node.get_clock().now().nanoseconds * 1e-9 - seconds) < 1e-3, 5.0
    )


def simulated(*times: float) -> Callable[[Bench], str]:
    """use_sim_time from now on, and a clock that shows these times; none: there is no clock."""

    def do(bench: Bench) -> str:
        assert bench.set("use_sim_time", True)
        found = depth_goes_on(bench, RAW)
        for seconds in times:
            clock(bench, seconds)
            found = depth_goes_on(bench, RAW)
        assert bench.set("use_sim_time", False)
        return found

    return do


JUMPED = "reset .*ROS time jumped"
UNTIED = "no pose of the camera: the odometry is of 'base_link', the images are of 'optical', and"
FAULTS = (
    refused("NaN", "the pose has values that are not finite", position(math.nan)),
    refused("infinity", "the pose has values that are not finite", position(math.inf)),
    refused("a quaternion of 0", "quaternion has length 0, expected 1", quaternion(0.0)),
    refused("a quaternion of length 2", "quaternion has length 2, expected 1", quaternion(2.0)),
    refused("a jump of 1000 km", r"jumped by 1e.06 m in .*, at most 10 m/s", position(1e6)),
    refused("poses of another frame", "a pose of another in other is not used", framed),
    refused("stamp 0", "the odometry stamps went back by .*", stamp_of_zero),
    refused("seconds -5, nanoseconds 2³² - 1", "stamps went back by .*", bad_stamp),
    Fault("odometry: covariance of NaN", strange_poses(covariance(math.nan)), camera=DRIVEN),
    Fault("odometry: covariance of -1", strange_poses(covariance(-1.0)), camera=DRIVEN),
    unknown(
        "no transform to the camera",
        f"{UNTIED} tf has no frame 'optical'",
        tf("base_link", "elsewhere"),
    ),
    unknown("values of NaN", UNTIED, tf("base_link", "optical", math.nan)),
    unknown("names of 5000 characters", UNTIED, tf("a" * 5000, "b" * 5000)),
    unknown(
        "a circle",
        "the transforms go in a circle: .*",
        tf("base_link", "optical"),
        tf("optical", "base_link"),
    ),
    Fault("no /clock with use_sim_time", simulated()),
    Fault("/clock stands still", simulated(100.0, 100.0, 100.0)),
    Fault("/clock goes back by 50 s", simulated(100.0, 50.0), (JUMPED,)),
    Fault("/clock goes back by 0.1 s", simulated(100.0, 99.9)),
    Fault("/clock jumps ahead by an hour", simulated(100.0, 3700.0), (JUMPED,)),
)
