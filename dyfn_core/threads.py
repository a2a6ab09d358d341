"""How many CPU threads compute."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
