"""Hub ids: what is not supported is refused, by what it is, before a download."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dyfn_core.models import CheckpointError, load_model
from dyfn_core.models.hub_files import MOST_FILES, SUPPORTED
from tests.support.fake_hub import fake_hub


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("depth-anything/DA3-LARGE", "Depth Anything 3 for several views"),
        ("depth-anything/DA3NESTED-GIANT-LARGE", "Depth Anything 3 for several views"),
        (
            "depth-anything/Depth-Anything-V2-Small-hf",
            "Depth Anything V2 in the format of transformers",
        ),
        ("depth-anything/Depth-Anything-V2-Metric-Indoor-Large", "metric Depth Anything V2"),
        ("depth-anything/Video-Depth-Anything-Small", "Video Depth Anything"),
        ("LiheYoung/depth_anything_vits14", "Depth Anything V1"),
        ("Ruicheng/moge-2-vitg", "another MoGe v2"),
        ("ruicheng/MoGe-3-vitl", "MoGe v3"),
    ],
)
def test_a_known_owner_is_refused_by_name_alone(
    name: str, found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = fake_hub(monkeypatch, tmp_path, {})
    with pytest.raises(CheckpointError) as caught:
        load_model(name)
    message = str(caught.value)
    assert message.startswith(f"Hub model {name} is {found}")
    assert all(repo in message for repo in SUPPORTED)
    assert hub.asked == []


@pytest.mark.parametrize(
    ("config", "found"),
    [
        (
            {"model_type": "depth_pro", "architectures": ["DepthProForDepthEstimation"]},
            "{'model_type': 'depth_pro', 'architectures': ['DepthProForDepthEstimation']}",
        ),
        ({"library": "timm", "x": 1}, "{'library': 'timm'}"),
        ({"x": 1}, "nothing of a model"),
        ([1], "nothing of a model"),
    ],
)
def test_a_stranger_is_refused_by_its_config(
    config: Any, found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "config.json").write_text(json.dumps(config))
    files = {"config.json": tmp_path / "config.json", "model.safetensors": tmp_path / "absent"}
    hub = fake_hub(monkeypatch, tmp_path, files)
    with pytest.raises(CheckpointError) as caught:
        load_model("someone/model")
    assert f"its config.json says {found}; supported are " in str(caught.value)
    assert "someone/model/FILE" in str(caught.value)
    assert hub.downloads == ["config.json"]


def test_a_config_that_is_no_json_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "config.json").write_text("<html>")
    fake_hub(monkeypatch, tmp_path, {"config.json": tmp_path / "config.json"})
    with pytest.raises(CheckpointError, match=r"Hub model me/mine: its config\.json is no JSON"):
        load_model("me/mine")


def test_a_repository_without_a_config_is_told_by_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [".gitattributes", *(f"part_{index}.bin" for index in range(MOST_FILES + 3))]
    hub = fake_hub(monkeypatch, tmp_path, dict.fromkeys(names, tmp_path))
    with pytest.raises(CheckpointError) as caught:
        load_model("someone/model")
    assert "no config.json that says what it is; it has part_0.bin, part_1.bin" in str(caught.value)
    assert " and 3 more; supported are" in str(caught.value)
    assert ".gitattributes" not in str(caught.value)
    assert hub.downloads == []
    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", lambda *_, **__: 1 / 0)
    with pytest.raises(CheckpointError, match="says what it is; supported are"):
        load_model("someone/model")


def test_a_hub_that_may_not_be_asked_is_told_by_its_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="HF_HUB_OFFLINE is set") as caught:
        load_model("Ruicheng/moge-vitl")
    assert "check your connection" not in str(caught.value)
