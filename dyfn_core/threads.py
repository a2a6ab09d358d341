"""How many CPU threads compute."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

# The same for the node and for dyfn-replay, whatever the machine has. The bundled models do not
# depend on it (dyfn_core.models.deterministic); a model made of torch's own layers may.
THREADS = 2


@contextmanager
def computing_threads(threads: int) -> Iterator[int]:
    """Set torch's CPU threads within the block, 0 leaves them; gives the number in force."""
    import torch

    before = torch.get_num_threads()
    try:
        if threads:
            torch.set_num_threads(threads)
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)


def one_blas_thread() -> AbstractContextManager[object]:
    """Within the block numpy and scipy solve on one thread; torch is left alone.

    For the small matrices of one frame: more threads are no faster, and those that wait for work
    spin. Without threadpoolctl nothing is limited.
    """
    blas = _numpy_blas()
    return nullcontext() if blas is None else blas.limit(limits=1)


@cache
def _numpy_blas() -> ThreadpoolController | None:
    """The linear algebra that is loaded by now, without torch's own."""
    try:
        from threadpoolctl import ThreadpoolController
    except ImportError:
        return None
    loaded = ThreadpoolController().select(user_api="blas")
    return loaded.select(
        filepath=[one["filepath"] for one in loaded.info() if "/torch/" not in one["filepath"]]
    )
