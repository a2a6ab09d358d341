"""How many CPU threads compute: a part of the result, to the last bits of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

# The same for the node and for dyfn-replay, whatever the machine has: the libraries under torch
# sum in another order on another number of threads.
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
