"""Measurements for the metric scale that measure nothing, or something else."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from sensor_msgs.msg import Image, LaserScan, PointCloud2, Range
from std_srvs.srv import Trigger

from tests.support.faults.bench import MEASURED, METRES, Bench, faulty_bench, true_depth
from tests.support.faults.fault import Fault
from tests.support.faults.measurements import cloud, measurement
from tests.support.faults.pictures import HUGE, NO_METRES, floats, outcome, png, raw_image
from tests.support.probe import stamped
from tests.support.ros_graph import image_message

COUNT = 6  # pictures with such a measurement each
Change = Callable[[Any], object]


@contextmanager
def reference_bench(domain: dict[str, str]) -> Iterator[Bench]:
    """Cameras beside a sensor of each type, which sees METRES in a unit of the model."""
    with faulty_bench(domain, tuple(MEASURED)) as bench:
        yield bench


def no_metres(
    camera: str, says: str, change: Change, frame: str = "", late: float = 0.0
) -> Callable[[Bench], str]:
    """Nothing is known of the scale, and such measurements come: no metres come of them.

    says: what diagnostics say before good ones come. change: of a good measurement.
    frame: frame_id. late: seconds after the picture.
    """

    def do(bench: Bench) -> str:
        since = len(bench.said)
        assert bench.ask(Trigger, f"{camera}/reset", Trigger.Request()).success
        for _ in range(COUNT):
            image, stamp = bench.fresh(), bench.step()
            message = measurement(MEASURED[camera], METRES * true_depth(image))
            message = change(message) or message
            stamped(message, stamp + round(late * 1e9), frame)
            bench.probe.publish(f"/{camera}/reference", message)
            found = outcome(bench, bench.work(camera, image_message(image), stamp), None)
            assert found == NO_METRES, f"metres of nothing: {found}"
        bench.wait_said(says, since)
        return NO_METRES

    return do


def refused(camera: str, name: str, says: str, change: Change, **options: Any) -> Fault:
    do = no_metres(camera, says, change, **options)
    return Fault(f"{MEASURED[camera]}: {name}", do, (says,), True, camera, within=5)


def kept(camera: str, name: str, change: Change) -> Fault:
    """Wrong measurements for a while when the scale is known: the metres stay right."""

    def do(bench: Bench) -> str:
        for _ in range(COUNT):
            image, stamp = bench.fresh(), bench.step()
            message = measurement(MEASURED[camera], METRES * true_depth(image))
            message = change(message) or message
            bench.probe.publish(f"/{camera}/reference", stamped(message, stamp, ""))
            depth = bench.work(camera, image_message(image), stamp)
            assert depth is not None
            assert bench.right(depth / METRES, image)
        return "metres right"

    return Fault(f"{MEASURED[camera]}: {name} once metres are known", do, camera=camera)


def points(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def made(message: PointCloud2) -> PointCloud2:
        found = np.frombuffer(message.data, "<f4").reshape(-1, 3)
        return cloud(change(found.astype(np.float64)))

    return made


def without_x(message: PointCloud2) -> None:
    message.fields[0].name = "intensity"


def of_integers(message: PointCloud2) -> None:
    message.fields[2].datatype = 5


def cut(message: Any) -> None:
    message.data = message.data[:-100]


def small_step(message: PointCloud2) -> None:
    message.point_step = 4


def endless(message: PointCloud2) -> None:
    message.width = message.height = message.row_step = HUGE


def far_offset(message: PointCloud2) -> None:
    message.fields[2].offset = HUGE


def shifted(offset: float) -> Change:
    return points(lambda found: found + np.array([0.0, 0.0, offset]))


def ranges(value: float) -> Change:
    def change(message: LaserScan) -> None:
        message.ranges = [value] * len(message.ranges)

    return change


def without_angle(message: LaserScan) -> None:
    message.angle_increment = math.nan


def no_rays(message: LaserScan) -> None:
    message.ranges = []


def with_range(value: float) -> Change:
    def change(message: Range) -> None:
        message.range = value

    return change


def view(value: float) -> Change:
    def change(message: Range) -> None:
        message.field_of_view = value

    return change


def nothing(message: Any) -> None:
    pass


def a_picture(message: Image) -> Image:
    return raw_image(png(np.zeros((48, 64, 3), np.uint8)), 64, 48, "rgb8")


def no_depth(message: Image) -> Image:
    return floats(np.nan)


def useless(why: str) -> str:
    """What diagnostics and ~/scale/status say."""
    return f"scale: nothing usable: .*{why}"


MISSING = useless("missing")
FAULTS = (
    refused(
        "cloud",
        "points at 10³⁸ m",
        useless("beyond reference_max_depth"),
        points(lambda p: p * 1e38),
    ),
    refused("cloud", "65.535 for no return", MISSING, points(lambda p: p * 0 + 65.535)),
    refused("cloud", "NaN", MISSING, points(lambda p: p * np.nan)),
    refused("cloud", "infinity", MISSING, points(lambda p: p * np.inf)),
    refused("cloud", "no points", useless("an empty measurement"), points(lambda p: p[:0])),
    refused(
        "cloud", "points behind the camera", useless("behind the camera"), points(lambda p: -p)
    ),
    refused("cloud", "no x", "WARN .*expected x, y and z", without_x),
    refused("cloud", "integers for z", "WARN .*z of the cloud is no FLOAT32", of_integers),
    refused("cloud", "fewer bytes than it says", "WARN .*row_step 2304, has 2204 bytes", cut),
    refused("cloud", "point_step 4", "WARN .*point_step 4 does not hold x, y and z", small_step),
    refused("cloud", "2³² - 1 points", "WARN .*row_step 4294967295, has 2304 bytes", endless),
    refused("cloud", "z beyond all bytes", "WARN .*point_step 12 does not hold", far_offset),
    refused(
        "cloud",
        "a frame_id unknown to tf",
        "WARN .*its frame_id is 'mast', the images are of 'optical'",
        nothing,
        frame="mast",
    ),
    refused("cloud", "stamps 10 s ahead", r"scale: no measurement[^;]*", nothing, late=10.0),
    refused("scan", "NaN", MISSING, ranges(math.nan)),
    refused("scan", "infinity", MISSING, ranges(math.inf)),
    refused("scan", "less than 0", MISSING, ranges(-1.0)),
    refused("scan", "an angle of NaN", MISSING, without_angle),
    refused("scan", "no rays", useless("an empty measurement"), no_rays),
    refused("sonar", "NaN", MISSING, with_range(math.nan)),
    refused("sonar", "beyond its own max_range", MISSING, with_range(1e6)),
    refused("sonar", "field_of_view NaN", "WARN .*field_of_view is nan, expected", view(math.nan)),
    refused("sonar", "field_of_view 7", "WARN .*field_of_view is 7.0, expected", view(7.0)),
    refused("dense", "a colour picture", "WARN .*encoding 'rgb8' is no depth", a_picture),
    refused("dense", "all NaN", MISSING, no_depth),
    refused("dense", "fewer bytes than it says", "WARN .*data has .* bytes, but", cut),
    refused(
        "dense",
        "of another place",
        "WARN .*its frame_id is 'mast', the images are of 'optical'",
        nothing,
        frame="mast",
    ),
    kept("cloud", "points at 10³⁸ m", points(lambda p: p * 1e38)),
    kept("cloud", "half a metre off", shifted(0.5)),
    kept("scan", "ten times too far", ranges(29.0)),
    kept("sonar", "ten times too far", with_range(29.0)),
)
