"""How many threads numpy and torch compute with."""

from __future__ import annotations

import sys

import pytest
import scipy.linalg  # noqa: F401  (has linear algebra of its own)
import torch
from threadpoolctl import threadpool_info

from dyfn_core import threads


def blas_threads() -> list[int]:
    """Of each linear algebra that is loaded, without torch's own."""
    info = threadpool_info()
    return [
        one["num_threads"]
        for one in info
        if one["user_api"] == "blas" and "/torch/" not in one["filepath"]
    ]


def test_numpy_solves_on_one_thread_within_the_block_and_torch_keeps_its_own() -> None:
    before, torchs = blas_threads(), torch.get_num_threads()
    assert before, "numpy has no linear algebra that can be asked"
    with threads.one_blas_thread():
        assert set(blas_threads()) == {1}
        assert torch.get_num_threads() == torchs
    assert blas_threads() == before


def test_without_threadpoolctl_the_block_runs_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    before = blas_threads()
    threads._numpy_blas.cache_clear()
    monkeypatch.setitem(sys.modules, "threadpoolctl", None)
    try:
        with threads.one_blas_thread():
            assert blas_threads() == before
    finally:
        threads._numpy_blas.cache_clear()


def test_torchs_threads_are_set_within_the_block_alone() -> None:
    before = torch.get_num_threads()
    with threads.computing_threads(1) as number:
        assert number == torch.get_num_threads() == 1
    assert torch.get_num_threads() == before
    with threads.computing_threads(0) as number:
        assert number == before
