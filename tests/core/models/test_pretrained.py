"""DyFNModel: a model and what is known of it, as a folder and on the Hub."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from huggingface_hub import HfApi, ModelCard
from safetensors.torch import load

import dyfn_core
from dyfn_core import CheckpointError, DyFNModel, ModelFacts, load_model, save_model
from dyfn_core.models import hub_files
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.hub_files import SUPPORTED
from dyfn_core.models.mini import MiniModel
from dyfn_core.models.model_card import COUNTERS, LICENSES, without_folders
from dyfn_core.training.loop import trainer
from tests.support.bases import moge2_config, small_moge2
from tests.support.fake_hub import FakeHub, fake_hub

FACTS = ModelFacts(
    base_model="dyfn-mini",
    data=("walks of a robot",),
    training={"steps": 7, "method": {"kind": "unrolled"}},
    metrics={"video AbsRel": 0.125},
)


def small_mini() -> MiniModel:
    torch.manual_seed(0)
    model = MiniModel().eval()
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig(hidden=8, pool=4))
    return model


def with_dyfn(model: GeometryModel) -> GeometryModel:
    torch.manual_seed(1)
    model.stabilizer = build_dyfn(model.latent_channels, DyFNConfig(hidden=8, pool=2))
    return model.eval()


BASES = {
    "mini": small_mini,
    "moge2": lambda: with_dyfn(small_moge2()),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """As save_pretrained writes it."""
    DyFNModel(small_mini(), FACTS).save_pretrained(tmp_path / "mine")
    return tmp_path / "mine"


@pytest.mark.parametrize("base", BASES)
def test_folder_keeps_every_bit(base: str, tmp_path: Path) -> None:
    model = BASES[base]()
    DyFNModel(model, FACTS).save_pretrained(tmp_path / "mine")
    again = DyFNModel.from_pretrained(tmp_path / "mine")
    assert again.facts == DyFNModel(model, FACTS).facts
    state = again.model.state_dict()
    assert state.keys() == model.state_dict().keys()
    assert all(torch.equal(value, state[key]) for key, value in model.state_dict().items())
    image = np.random.default_rng(0).integers(0, 256, (56, 56, 3), dtype=np.uint8)
    assert torch.equal(again.model.infer(image).depth, model.infer(image).depth)
    assert not again.model.training


def test_folder_is_one_for_load_model_too(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md",
        "config.json",
        "model.safetensors",
    ]
    state = load_model(folder).state_dict()
    assert all(torch.equal(state[key], value) for key, value in small_mini().state_dict().items())


def test_card_says_what_is_known(folder: Path) -> None:
    card = ModelCard.load(folder / "README.md")
    assert card.data.license == "apache-2.0"
    assert card.data.library_name == "dyfn_ros"
    assert card.data.pipeline_tag == "depth-estimation"
    assert card.data.base_model is None  # no repository of the Hub
    for said in (
        "| base model | dyfn-mini |",
        "walks of a robot",
        "| video AbsRel | 0.125 |",
        "steps: 7",
    ):
        assert said in card.text, said
    config = json.loads((folder / "config.json").read_text())
    assert config["library"] == "dyfn_ros"
    assert config["facts"]["metrics"] == {"video AbsRel": 0.125}


def test_card_that_is_there_stays(folder: Path) -> None:
    (folder / "README.md").write_text("# My own words\n")
    DyFNModel.from_pretrained(folder).save_pretrained(folder)
    assert (folder / "README.md").read_text() == "# My own words\n"


def test_licence_is_that_of_the_base() -> None:
    model = small_moge2()
    known = DyFNModel(model, ModelFacts(base_model="Ruicheng/moge-2-vits-normal"))
    assert known.generate_model_card().data.license == "mit"
    assert known.generate_model_card().data.base_model == "Ruicheng/moge-2-vits-normal"
    unknown = DyFNModel(model).generate_model_card()
    assert unknown.data.license is None
    assert "| licence | not known; that of the base |" in unknown.text
    assert "without DyFN" in unknown.text
    given = DyFNModel(model, ModelFacts(license="cc-by-4.0", base_model="a/b"))
    assert given.generate_model_card().data.license == "cc-by-4.0"


def test_licences_are_those_of_the_manual() -> None:
    assert set(LICENSES) == set(SUPPORTED) - {"shawlyu/DyFN"}
    page = (Path(__file__).parents[3] / "docs/models.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for repo, name in LICENSES.items():
        size = repo.removeprefix("depth-anything/Depth-Anything-V2")
        row = next(row for row in rows if f"`{repo}`" in row or f"`{size}`" in row)
        assert f"| {name} |" in row.lower().replace("cc by-nc 4.0", "cc-by-nc-4.0"), row


def made_run(folder: Path, **results: Any) -> Path:
    folder.mkdir()
    save_model(small_mini(), folder / "model.safetensors", notes={"trained_steps": "9"})
    config = {
        "base": "/home/someone/models/base.safetensors",
        "data": ["/media/disk/walk.mcap", "recording=data/other.mcap"],
        "method": {"kind": "linearized", "cache": None},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    if results:
        (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_run_of_dyfn_train_tells_its_training(tmp_path: Path) -> None:
    found = DyFNModel.from_pretrained(
        made_run(tmp_path / "run", step=9, best=0.2, rendered_dyfn_video=0.19, odd=None)
    )
    assert found.facts.base_model == "base.safetensors"
    assert found.facts.data == ("walk.mcap", "recording=other.mcap")
    assert found.facts.metrics == {"rendered_dyfn_video": 0.19}
    assert found.facts.training == {
        "method": {"kind": "linearized", "cache": None},
        "trained_steps": 9,
    }
    card = found.generate_model_card().content
    assert "walk.mcap" in card
    for private in ("/home", "someone", "/media", str(tmp_path)):
        assert private not in card, private
    unfinished = DyFNModel.from_pretrained(made_run(tmp_path / "unfinished"))
    assert unfinished.facts.metrics == {}
    assert set(trainer.COUNTERS) < set(COUNTERS)


def test_paths_lose_their_folders() -> None:
    assert without_folders("{root: ~/a/b.mcap, kind: recording, x: ../c/d}") == (
        "{root: b.mcap, kind: recording, x: d}"
    )
    assert without_folders({"a": ["/b/c d/e.bag", 3, None, "1/2/"]})["a"][1:3] == [3, None]


def test_a_bundled_model_and_a_file_have_facts(tmp_path: Path) -> None:
    assert DyFNModel.from_pretrained("dyfn-mini").facts.license == "apache-2.0"
    save_model(small_mini(), tmp_path / "a.safetensors", notes={"adapted_from": "dyfn-mini"})
    assert DyFNModel.from_pretrained(tmp_path / "a.safetensors").facts.base_model == "dyfn-mini"


def edited(folder: Path, **changes: Any) -> None:
    """Changes config.json; None removes an entry."""
    path = folder / "config.json"
    values = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: v for k, v in values.items() if v is not None}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"library": "timm"}, "of another library: `library` is 'timm', expected 'dyfn_ros'"),
        ({"library": None}, "`library` is None"),
        ({"model": None, "odd": 1}, "model is missing, odd is unknown; expected library, format"),
        ({"format": "dyfn 9"}, "format 'dyfn 9' is not supported"),
        ({"model": {"type": "moge"}}, "another model than model.safetensors .*type: 'moge' / 'mi"),
        ({"model": 3}, "another model than"),
        ({"facts": {"licence": "x"}}, "facts: licence: "),
        ({"facts": {"metrics": {"a": "b"}}}, "facts: metrics.a: "),
    ],
)
def test_wrong_config_is_refused_by_name(
    folder: Path, changes: dict[str, Any], message: str
) -> None:
    edited(folder, **changes)
    with pytest.raises(CheckpointError, match=message) as caught:
        DyFNModel.from_pretrained(folder)
    assert str(folder / "config.json") in str(caught.value)


def test_missing_and_damaged_files_are_named(folder: Path, tmp_path: Path) -> None:
    (folder / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"config\.json is no JSON"):
        DyFNModel.from_pretrained(folder)
    (folder / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"neither a config\.json.*nor a config\.yaml"):
        DyFNModel.from_pretrained(folder)
    (folder / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=str(folder / "model.safetensors")):
        load_model(folder)
    (folder / "config.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=str(folder / "model.safetensors")):
        DyFNModel.from_pretrained(folder)
    with pytest.raises(FileNotFoundError, match="no model 'absent'"):
        DyFNModel.from_pretrained("absent")
    with pytest.raises(TypeError, match="map_location"):
        DyFNModel.from_pretrained(folder, map_location="cpu")


@pytest.fixture
def hub(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeHub:
    """One repository, which is what save_pretrained wrote."""
    return fake_hub(monkeypatch, tmp_path, {path.name: path for path in folder.iterdir()})


def test_hub_is_asked_as_told(hub: FakeHub, tmp_path: Path) -> None:
    told = {"revision": "v2", "cache_dir": tmp_path / "cache", "token": "hf_x"}
    found = DyFNModel.from_pretrained("me/mine", force_download=True, **told)
    assert found.facts.metrics == FACTS.metrics
    downloads = [(name, options) for name, options in hub.asked if "/" not in name]
    assert [name for name, _ in downloads] == ["config.json", "model.safetensors"]
    for _, options in downloads:
        assert {
            **told,
            "force_download": True,
            "local_files_only": False,
        }.items() <= options.items()
    addresses = [(url, options) for url, options in hub.asked if "/" in url]
    for (url, options), (name, _) in zip(addresses, downloads, strict=True):
        assert url.endswith(f"me/mine/resolve/v2/{name}")
        assert options["token"] == "hf_x"


def test_a_foreign_repository_is_refused_before_its_weights(hub: FakeHub, folder: Path) -> None:
    edited(folder, library="transformers")
    with pytest.raises(CheckpointError, match=r"'library': 'transformers'.*supported are"):
        DyFNModel.from_pretrained("me/mine")
    del hub.files["config.json"]
    told = r"no config\.json that says what it is; it has README\.md, model\.safetensors; supported"
    with pytest.raises(CheckpointError, match=told):
        DyFNModel.from_pretrained("me/mine")
    assert not any("safetensors" in name for name, _ in hub.asked)


def test_a_release_tells_its_licence(hub: FakeHub, tmp_path: Path) -> None:
    content = {"model_config": moge2_config(), "model": small_moge2().state_dict()}
    torch.save(content, tmp_path / "model.pt")
    hub.files["model.pt"] = tmp_path / "model.pt"
    found = DyFNModel.from_pretrained("Ruicheng/moge-2-vits-normal")
    assert found.facts == ModelFacts(license="mit", base_model="Ruicheng/moge-2-vits-normal")


def test_only_the_cache_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DYFN_MODELS", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.get_hf_file_metadata", lambda *_, **__: pytest.fail())
    with pytest.raises(FileNotFoundError, match="local_files_only forbids") as caught:
        DyFNModel.from_pretrained("me/mine", local_files_only=True, cache_dir=tmp_path / "cache")
    assert f"in the cache {tmp_path / 'cache'}" in str(caught.value)


def test_what_the_cache_has_needs_no_network(folder: Path, tmp_path: Path) -> None:
    commit = "0" * 40
    snapshot = tmp_path / "cache" / "models--me--mine" / "snapshots" / commit
    snapshot.parent.mkdir(parents=True)
    folder.rename(snapshot)
    for name in ("main", "v2"):
        ref = snapshot.parents[1] / "refs" / name
        ref.parent.mkdir(exist_ok=True)
        ref.write_text(commit)
    for revision in (None, "v2", commit):
        found = DyFNModel.from_pretrained(
            "me/mine", cache_dir=tmp_path / "cache", revision=revision, local_files_only=True
        )
        assert found.facts.data == FACTS.data
    with pytest.raises(FileNotFoundError, match=r"config.*at revision v3 in the cache|safetensors"):
        DyFNModel.from_pretrained(
            "me/mine", cache_dir=tmp_path / "cache", revision="v3", local_files_only=True
        )


def test_a_hub_that_does_not_answer_is_waited_for_briefly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DYFN_MODELS", str(tmp_path))
    monkeypatch.setattr(hub_files, "ANSWER", 0.2)
    monkeypatch.setattr("huggingface_hub.get_hf_file_metadata", lambda *_, **__: time.sleep(2))
    monkeypatch.setattr("huggingface_hub.hf_hub_download", lambda **_: pytest.fail("downloaded"))
    started = time.monotonic()
    with pytest.raises(FileNotFoundError, match=r"TimeoutError: no answer within 0\.2 s") as caught:
        DyFNModel.from_pretrained("me/mine", cache_dir=tmp_path / "cache")
    assert time.monotonic() - started < 1.5
    message = str(caught.value)
    assert str(tmp_path / "cache") in message
    assert str(tmp_path / "me" / "mine" / "model.safetensors") in message
    assert "\n" not in message


def test_push_uploads_what_is_on_disk(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    sent: dict[str, Any] = {}

    def create_repo(_: HfApi, repo_id: str, **options: Any) -> Any:
        sent["created"] = (repo_id, options)
        return type("Made", (), {"repo_id": repo_id})

    def upload_folder(_: HfApi, *, folder_path: Path, **options: Any) -> str:
        sent["files"] = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
        sent["options"] = options
        return "https://hub/commit"

    monkeypatch.setattr(HfApi, "create_repo", create_repo)
    monkeypatch.setattr(HfApi, "upload_folder", upload_folder)
    model = DyFNModel.from_pretrained(folder)
    told = model.push_to_hub("me/mine", private=True, branch="v2", commit_message="mine")
    assert told == "https://hub/commit"
    assert sent["created"] == ("me/mine", {"private": True, "exist_ok": True})
    assert sent["options"]["revision"] == "v2"
    assert sent["options"]["commit_message"] == "mine"
    assert sent["files"]["config.json"] == (folder / "config.json").read_bytes()
    weights, own = load(sent["files"].pop("model.safetensors")), model.model.state_dict()
    assert weights.keys() == own.keys()
    assert all(torch.equal(weights[key], own[key]) for key in own)
    card = sent["files"].pop("README.md").decode()
    assert 'DyFNModel.from_pretrained("me/mine")' in card
    assert "\n# mine\n" in card
    assert set(sent["files"]) == {"config.json"}


def test_the_hubs_library_is_imported_when_it_is_needed_only() -> None:
    code = (
        "import sys, dyfn_core; dyfn_core.load_model('dyfn-mini'); print('huggingface_hub' in "
        "sys.modules); dyfn_core.DyFNModel; print('huggingface_hub' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "False\nTrue\n"
    assert dyfn_core.DyFNModel is DyFNModel
