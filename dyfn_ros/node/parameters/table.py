"""The node's parameters: the one table that declarations, manual and parameter file come from."""

# ruff: noqa: RUF009  (_parameter only describes a field)

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from dyfn_core.argument_types import BACKENDS
from dyfn_core.stream.options import SCALE, STREAM, StreamOptions
from dyfn_core.threads import THREADS
from dyfn_ros.messages.odometry_options import OdometryOptions
from dyfn_ros.messages.reference_options import ReferenceOptions
from dyfn_ros.node.parameters.spec import CONFIGURE, MARKS, RUN, START, Spec, spec_of
from dyfn_ros.node.parameters.spec import parameter as _parameter

__all__ = [
    "CONFIGURE",
    "LIMITS",
    "MARKS",
    "RUN",
    "SPECS",
    "START",
    "NodeSettings",
    "Spec",
    "groups",
    "show",
]

_NODE, _INPUT, _OUTPUT, _CLOUD = "Node", "Input", "Output", "Cloud"


@dataclass(frozen=True)
class NodeSettings(OdometryOptions, ReferenceOptions, StreamOptions):
    """The values in force; a new one for each change. The fields are the table."""

    cameras: list[str] = _parameter(
        _NODE,
        [""],
        "Names of the cameras. Camera NAME has the topics `NAME/image`, `NAME/camera_info` and "
        "`~/NAME/...`; one empty name is a single camera without these prefixes.",
        changes=START,
    )
    autostart: bool = _parameter(
        _NODE,
        True,
        "Configure and activate at start. False: wait for a lifecycle manager.",
        changes=START,
    )
    model: str = _parameter(_NODE, "dyfn-mini", "Bundled model's name, checkpoint file, or Hub id.")
    device: str = _parameter(
        _NODE,
        "auto",
        "Device that runs the model: auto (a GPU if there is one), cpu, cuda, cuda:N. Cameras of "
        "several devices have a model and a thread for each.",
        per_camera=True,
    )
    backend: str = _parameter(
        _NODE,
        "torch",
        "Library that runs the network: torch, onnxruntime, openvino, tensorrt, compile; auto: the "
        "fastest that is installed, which the log names.",
        choices=BACKENDS,
    )
    threads: int = _parameter(
        _NODE,
        THREADS,
        "CPU threads for inference; the depth does not depend on them; 0: torch's own choice.",
        range=(0, 1024),
    )
    batch: bool = _parameter(
        _NODE,
        True,
        "Frames of several cameras that wait together, of one size, run as one batch. False: one "
        "after the other. On a CPU each camera's depth has the same bytes either way.",
        changes=RUN,
    )
    diagnostics_period: float = _parameter(
        _NODE, 1.0, "Seconds between two messages on /diagnostics.", range=(0.05, 3600.0)
    )

    image_transport: str = _parameter(
        _INPUT,
        "raw",
        "raw subscribes `image`, compressed subscribes `image/compressed`.",
        per_camera=True,
        choices=("raw", "compressed"),
    )
    reliability: str = _parameter(
        _INPUT,
        "auto",
        "QoS reliability of image and camera_info. auto: reliable when all publishers of the topic "
        "are, else best effort; looked at again as they come and go.",
        per_camera=True,
        choices=("auto", "best_effort", "reliable"),
    )
    max_megapixels: float = _parameter(
        _INPUT,
        12.5,
        "Larger images are refused, before they are decoded; 1 is 1024 x 1024 pixels.",
        changes=RUN,
        per_camera=True,
        range=(0.001, 64.0),
    )
    image_bits: int = _parameter(
        _INPUT,
        16,
        "Bits that the values of 16-bit encodings (mono16, bayer_rggb16, ...) have: 12 for a "
        "camera of 12 bits whose values are not shifted up.",
        changes=RUN,
        per_camera=True,
        range=(8, 16),
    )
    max_rate: float = _parameter(
        _INPUT,
        0.0,
        "Images a second, by their stamps, that are worked on; the others are skipped. 0 is no "
        "limit.",
        changes=RUN,
        per_camera=True,
        range=(0.0, 1000.0),
    )
    drop_frames: bool = _parameter(
        _INPUT,
        True,
        "Process the latest frame and drop those that came meanwhile. False: queue and process "
        "every frame in order, for recordings.",
    )
    queue_size: int = _parameter(
        _INPUT,
        1000,
        "Frames of one camera that may wait when drop_frames is false.",
        range=(1, 1_000_000),
    )
    wait_for_camera_info: bool = _parameter(
        _INPUT,
        False,
        "Hold the first frames until a CameraInfo has come, so that all have intrinsics.",
        per_camera=True,
    )
    rectified: bool = _parameter(
        _INPUT,
        False,
        "The images are rectified: take P of the CameraInfo instead of K and D. So are those whose "
        "topic says so (`image_rect`, `rect/image`).",
        changes=RUN,
        per_camera=True,
    )
    distortion: str = _parameter(
        _INPUT,
        "undistort",
        "Images with D other than 0. undistort: outputs are those of the undistorted image with "
        "the same K. refuse: such images are errors. ignore: D is taken as 0.",
        changes=RUN,
        per_camera=True,
        choices=("undistort", "refuse", "ignore"),
    )
    check_frame_id: bool = _parameter(
        _INPUT,
        True,
        "Ignore a CameraInfo whose frame_id differs from the image's.",
        changes=RUN,
        per_camera=True,
    )

    state_folder: str = _parameter(
        _NODE,
        "",
        "Folder that state_file must be in, links followed, whoever sets it; empty: the folder of "
        "the state_file given at start.",
        changes=START,
    )

    publish_depth: bool = _parameter(
        _OUTPUT, True, "Publish ~/depth/... when somebody subscribes.", changes=RUN, per_camera=True
    )
    publish_points: bool = _parameter(
        _OUTPUT, True, "Publish ~/points when somebody subscribes.", changes=RUN, per_camera=True
    )
    depth_encoding: str = _parameter(
        _OUTPUT,
        "32FC1",
        "Encoding of ~/depth/image. 32FC1: NaN where invalid. 16UC1: thousandths, 0 where invalid.",
        changes=RUN,
        per_camera=True,
        choices=("32FC1", "16UC1"),
    )
    publish_colored: bool = _parameter(
        _OUTPUT,
        True,
        "Publish ~/depth/colored when somebody subscribes.",
        changes=RUN,
        per_camera=True,
    )
    publish_normal: bool = _parameter(
        _OUTPUT,
        True,
        "Publish ~/normal, of a model that has normals, when somebody subscribes.",
        changes=RUN,
        per_camera=True,
    )
    output_scale: float = _parameter(
        _OUTPUT,
        1.0,
        "Size of depth, colours, cloud and their camera_info over the image's; each pixel has the "
        "depth of the image's pixel at its centre.",
        changes=RUN,
        per_camera=True,
        range=(0.01, 1.0),
    )
    min_depth: float = _parameter(
        _OUTPUT,
        0.0,
        "Nearer points become NaN; in the unit of the output depth.",
        changes=RUN,
        per_camera=True,
        range=(0.0, 1e6),
    )
    max_depth: float = _parameter(
        _OUTPUT,
        0.0,
        "Farther points become NaN; in the unit of the output depth; 0 is no limit.",
        changes=RUN,
        per_camera=True,
        range=(0.0, 1e6),
    )

    points_stride: int = _parameter(
        _CLOUD,
        1,
        "Every N-th row and column of the image gives a point.",
        changes=RUN,
        per_camera=True,
        range=(1, 64),
    )
    points_compact: bool = _parameter(
        _CLOUD,
        False,
        "16 bytes a point (x y z rgb) instead of the 32 of PCL's PointXYZRGB: half the memory and "
        "bandwidth.",
        changes=RUN,
        per_camera=True,
    )
    points_min_depth: float = _parameter(
        _CLOUD,
        0.0,
        "min_depth of the cloud alone.",
        changes=RUN,
        per_camera=True,
        range=(0.0, 1e6),
    )
    points_max_depth: float = _parameter(
        _CLOUD,
        0.0,
        "max_depth of the cloud alone.",
        changes=RUN,
        per_camera=True,
        range=(0.0, 1e6),
    )
    points_edge_filter: float = _parameter(
        _CLOUD,
        0.0,
        "Flying pixels: a point whose depth differs from a neighbour pixel's by more than this "
        "share becomes NaN; 0 keeps all, 0.05 is usual.",
        changes=RUN,
        per_camera=True,
        range=(0.0, 10.0),
    )


SPECS: dict[str, Spec] = {entry.name: spec_of(entry) for entry in fields(NodeSettings)}

# Pairs of a lower and an upper limit; an upper limit of 0 is none.
LIMITS = (
    ("min_depth", "max_depth"),
    ("points_min_depth", "points_max_depth"),
    ("reference_min_depth", "reference_max_depth"),
)


def show(value: Any) -> str:
    """A default as YAML has it."""
    if isinstance(value, list):
        return f"[{', '.join(repr(item) for item in value)}]"
    if value == "":
        return "''"
    return str(value).lower() if isinstance(value, bool) else str(value)


def groups() -> dict[str, dict[str, Spec]]:
    """The table by heading, in order."""
    order = (_NODE, _INPUT, STREAM, SCALE, _OUTPUT, _CLOUD)
    result: dict[str, dict[str, Spec]] = {group: {} for group in order}
    for name, spec in SPECS.items():
        result[spec.group][name] = spec
    return result
