"""The device that a name asks for."""

from __future__ import annotations

import torch

AUTO = "auto"


def resolve_device(name: torch.device | str) -> torch.device:
    """The torch device of that name, checked.

    Args:
        name: "auto" (a GPU if there is one, else the CPU), or a name of torch's: "cpu", "cuda",
            "cuda:N", "mps".

    Returns:
        The device.

    Raises:
        ValueError: torch knows no such device, or this machine does not have it.

    Example:
        >>> resolve_device("cpu")
        device(type='cpu')
        >>> resolve_device("gpu")
        Traceback (most recent call last):
        ...
        ValueError: device 'gpu' is unknown, expected auto, cpu, cuda or cuda:N
    """
    if name == AUTO:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(
            f"device {name!r} is unknown, expected auto, cpu, cuda or cuda:N"
        ) from None
    if device.type == "cuda":
        count = torch.cuda.device_count()
        if (device.index or 0) >= count:
            raise ValueError(f"no device {str(device)!r} here: torch finds {count} CUDA devices")
    return device
