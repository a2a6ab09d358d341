"""Modules made without their random first weights, for weights that come from a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from torch import Tensor
from torch.nn import init
from torch.overrides import TorchFunctionMode

# torch.nn.init hands some of its functions on as a whole; the others end in a method of the tensor.
DRAWS = (
    init.kaiming_normal_,
    init.kaiming_uniform_,
    init.normal_,
    init.uniform_,
    Tensor.normal_,
    Tensor.uniform_,
)


class Undrawn(TorchFunctionMode):
    """Within this context weights are not drawn: the functions of DRAWS do nothing.

    A tensor keeps what its memory held, so every parameter made here must be loaded. On the meta
    device a draw would make torch import its compiler, which takes seconds.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Iterable[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Called by torch in place of `func`."""
        given = kwargs or {}
        if func in DRAWS:
            return args[0] if args else given["tensor"]
        return func(*args, **given)
