"""CameraInfos that describe no camera, or another one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo

from tests.support.faults.bench import FRAME, PATIENCE, RAW, SIZE, Bench
from tests.support.faults.fault import Fault
from tests.support.faults.pictures import HUGE, RIGHT, outcome
from tests.support.pinhole import FOV_X
from tests.support.probe import stamped
from tests.support.ros_graph import camera_info, image_message

FOCAL = SIZE[1] / 2 / math.tan(math.radians(FOV_X / 2))


def true_info() -> CameraInfo:
    """Of the camera that the model knows."""
    info = camera_info(*SIZE, FOCAL)
    middle = [SIZE[1] / 2 - 0.5, SIZE[0] / 2 - 0.5]
    info.k = [FOCAL, 0.0, middle[0], 0.0, FOCAL, middle[1], 0.0, 0.0, 1.0]
    info.p = [FOCAL, 0.0, middle[0], 0.0, 0.0, FOCAL, middle[1], 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


def send(bench: Bench, info: CameraInfo, frame: str = FRAME) -> None:
    """And wait until the node has it."""
    stamp = bench.step(0.0)
    bench.probe.publish("/raw/camera_info", stamped(info, stamp, frame))

    def known() -> bool:
        found = bench.camera(RAW)._info
        return found is not None and found.header == info.header and found == info

    if not math.isnan(sum(info.k) + sum(info.d)):
        bench.probe.wait(known, PATIENCE)
    else:  # is not equal to itself
        bench.probe.wait(lambda: str(bench.camera(RAW)._info) == str(info), PATIENCE)


def changed(change: Callable[[CameraInfo], object]) -> CameraInfo:
    info = true_info()
    change(info)
    return info


def ignored(*infos: CameraInfo, frame: str = FRAME) -> Callable[[Bench], str]:
    """Pictures have the depth that they have without a CameraInfo, while it lasts."""

    def do(bench: Bench) -> str:
        for info in infos:
            send(bench, info, frame)
            image = bench.fresh()
            assert outcome(bench, bench.work(RAW, image_message(image)), image) == RIGHT
        send(bench, true_info())
        return f"not used; {RIGHT} meanwhile"

    return do


def refused(
    name: str, says: str, *changes: Callable[[CameraInfo], object], frame: str = FRAME
) -> Fault:
    infos = [changed(change) for change in changes]
    return Fault(name, ignored(*infos, frame=frame), (f"WARN /raw/camera_info: .*{says}",), True)


def with_k(place: int, value: float) -> Callable[[CameraInfo], object]:
    def change(info: CameraInfo) -> None:
        info.k[place] = value

    return change


def with_(**fields: Any) -> Callable[[CameraInfo], object]:
    def change(info: CameraInfo) -> None:
        for name, value in fields.items():
            setattr(info, name, value)

    return change


def binned(info: CameraInfo) -> None:
    info.binning_x = info.binning_y = HUGE


def roi(info: CameraInfo) -> None:
    info.roi.x_offset = info.roi.y_offset = info.roi.width = info.roi.height = HUGE


def changing(bench: Bench) -> str:
    """Each changes the intrinsics of the stream, which begins anew."""
    for turn in range(10):
        send(bench, changed(with_k(0, FOCAL * (1 + 0.2 * (turn % 2)))))
        depth = bench.work(RAW, image_message(bench.fresh()))
        assert depth is not None
        assert np.isfinite(depth).any()
    send(bench, true_info())
    return "depth of every picture"


NO_CAMERA = "no pinhole camera matrix"
FAULTS = (
    refused("K with NaN", NO_CAMERA, with_k(0, math.nan), with_k(2, math.nan)),
    refused("K with infinity", NO_CAMERA, with_k(0, math.inf), with_k(5, -math.inf)),
    refused("K with a negative focal length", NO_CAMERA, with_k(0, -FOCAL), with_k(4, -1.0)),
    refused("K with skew", NO_CAMERA, with_k(1, 3.0)),
    refused("K of zeros", r"uncalibrated: K.0. is 0", with_k(0, 0.0)),
    refused("K of 10³⁰ or 10⁻³⁰", "of no real camera", with_k(0, 1e30), with_k(0, 1e-30)),
    refused("a principal point of 10⁹", "a principal point .* of no real camera", with_k(2, 1e9)),
    refused(
        "a size of 0 x 0, or of another picture",
        "is for 0 x 0 pixels, but the images have 64 x 48",
        with_(width=0, height=0),
        with_(width=640, height=480),
    ),
    refused("binning 2³² - 1", "is for 0 x 0 pixels, but", binned),
    refused("region of interest of 2³² - 1", "is for 4294967295 x 4294967295 pixels, but", roi),
    refused("D with NaN", "D has values that are no finite numbers", with_(d=[0.1, math.nan])),
    refused(
        "D of 10⁶",
        "of no real lens: 0.0% of the undistorted image would show something",
        with_(d=[1e6] * 5),
    ),
    refused(
        "an unknown lens model",
        "'of_a_stranger' with 3 coefficients cannot be undone",
        with_(distortion_model="of_a_stranger", d=[0.1, 0.2, 0.3]),
    ),
    refused(
        "three coefficients for plumb_bob",
        "'plumb_bob' with 3 coefficients cannot be undone",
        with_(d=[0.1, 0.2, 0.3]),
    ),
    refused(
        "100 000 coefficients",
        "with 100000 coefficients cannot be undone",
        with_(d=[0.001] * 100_000),
    ),
    refused("the frame_id of another camera", "frame_id is .other.", with_(), frame="other"),
    Fault("other intrinsics with every picture", changing, ("reset .*intrinsics changed",)),
)
