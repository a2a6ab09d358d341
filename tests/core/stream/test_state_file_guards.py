"""State files from strangers: refused with a reason, and nothing of others' is overwritten."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dyfn_core.prediction import Frame
from dyfn_core.stream import state_file
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.saving import StateError, check_folder
from dyfn_core.stream.session import StreamSession
from tests.core.stream.test_scene_cut import scene, seen
from tests.support.forged_state import forge, forge_deep, hidden_of
from tests.support.tiny_model import load_tiny


def picture(left: int = 0) -> np.ndarray:
    return np.ascontiguousarray(seen(scene(1), left)[::4, ::4])


def session(frames: int = 2) -> StreamSession:
    made = StreamSession(load_tiny(), StreamOptions())
    for index in range(frames):
        made.push(Frame(picture(index), index / 10))
    return made


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "s.safetensors"
    session().save(str(path))
    return path


def not_finite(content: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
    tensors[hidden_of(content)][:] = float("nan")


def no_memory(content: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
    content["state"]["fields"]["memory"] = "none"


def no_unit(content: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
    content["state"]["fields"]["memory"]["fields"]["unit"] = {"float": "-inf"}


@pytest.mark.parametrize("change", [not_finite, no_memory, no_unit])
def test_a_forged_state_is_refused(saved: Path, change: Callable[..., None]) -> None:
    forge(saved, change)
    one = session()
    with pytest.raises(StateError, match=r"unusable state|is bad"):
        one.load(str(saved))
    assert one.push(Frame(picture(3), 0.3)).reset is None  # as it was


def test_a_deep_description_is_refused(saved: Path) -> None:
    forge_deep(saved)
    with pytest.raises(StateError, match="is bad"):
        session().load(str(saved))


@pytest.mark.parametrize("what", ["memory", "cut"])
def test_a_state_of_other_shapes_costs_one_frame(saved: Path, what: str) -> None:
    def change(content: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        if what == "memory":
            tensors[hidden_of(content)] = torch.zeros(1, 3, 2, 2)
        else:
            look = content["state"]["fields"]["cut"]["fields"]["look"]["fields"]
            tensors[look["opponent"]["array"]] = torch.zeros(2, 2)

    forge(saved, change)
    one = session()
    one.load(str(saved))
    with pytest.raises(Exception):  # noqa: B017, whatever a wrong shape raises
        one.push(Frame(picture(3), 0.3))
    assert one.push(Frame(picture(4), 0.4)).reset == "inference failed"
    assert one.push(Frame(picture(5), 0.5)).reset is None


def test_what_is_no_regular_file_or_too_large_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe, large = tmp_path / "pipe", tmp_path / "large"
    os.mkfifo(pipe)
    large.write_bytes(b"x" * 2000)
    monkeypatch.setattr(state_file, "LARGEST", 1000)
    for path, reason in ((pipe, "regular"), (Path("/dev/zero"), "regular"), (large, "2000 bytes")):
        with pytest.raises(StateError, match=reason):
            session().load(str(path))


def test_only_state_files_are_replaced(saved: Path, tmp_path: Path) -> None:
    one = session()
    one.save(str(saved))
    assert "after 2 frames" in one.load(str(saved))
    text, link, pipe = tmp_path / "text", tmp_path / "link", tmp_path / "pipe"
    text.write_text("of somebody else")
    link.symlink_to(saved)
    os.mkfifo(pipe)
    for path in (text, link, pipe, Path("/dev/null"), tmp_path):
        with pytest.raises(StateError, match="not replaced"):
            one.save(str(path))
    assert text.read_text() == "of somebody else"
    assert link.is_symlink() and pipe.is_fifo()


def test_state_files_stay_in_their_folder(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "out").symlink_to(tmp_path)
    check_folder(str(inside / "s"), str(inside))
    check_folder("", "")
    for path in (tmp_path / "s", inside / ".." / "s", inside / "out" / "s", Path("/dev/full")):
        with pytest.raises(StateError, match="outside"):
            check_folder(str(path), str(inside))
    with pytest.raises(StateError, match="state_folder"):
        check_folder("anything", "")
