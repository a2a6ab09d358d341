"""dyfn-eval reconstruct and study, on a made RGB-D folder and a model that is right or random."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dyfn_core.cli import reconstruct, study
from dyfn_core.cli.eval import main
from dyfn_core.evaluation.empirical_study import statistics_grid
from dyfn_core.models.base import AffinePoints, Latent
from dyfn_core.models.checkpoints import load_model, save_model
from tests.support.bases import moge2_config, small_da3, small_moge2
from tests.support.fake_hub import fake_hub
from tests.support.made_room import FOCAL, SIZE, room_frame
from tests.support.pinhole import PinholeModel
from tests.support.seeded import uniform

FRAMES = 12


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """rgb/, depth/, K.txt and poses.txt."""
    folder = tmp_path_factory.mktemp("data") / "room"
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
    poses = []
    for index in range(FRAMES):
        frame = room_frame(index)
        cv2.imwrite(str(folder / "rgb" / f"{index:05d}.png"), frame.image[..., ::-1])
        depth = np.round(frame.depth * 1000).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{index:05d}.png"), depth)
        assert frame.pose is not None
        poses.append(frame.pose.ravel())
    np.savetxt(folder / "poses.txt", poses)
    height, width = SIZE
    camera = [[FOCAL, 0, (width - 1) / 2], [0, FOCAL, (height - 1) / 2], [0, 0, 1]]
    np.savetxt(folder / "K.txt", camera)
    return folder


@pytest.fixture(autouse=True)
def pinhole_model(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str, device: str, backend: str) -> PinholeModel:
        return PinholeModel(stabilized=True).eval()

    monkeypatch.setattr(reconstruct, "load_model", load)
    monkeypatch.setattr(study, "load_model", load)


def test_reconstruct_writes_table_clouds_and_report(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", str(room), "--out", str(tmp_path), "--offsets", "1", "3"]
    assert main([*words, "--matcher", "dis"]) == 0
    printed = capsys.readouterr().out
    found = json.loads((tmp_path / "reconstruction.json").read_text())
    assert set(found["runs"]) == {"true depth", "with DyFN", "base model"}
    exact = found["runs"]["true depth"]
    assert (exact["frames"], exact["posed"], exact["ply_in_metres"]) == (FRAMES, FRAMES, True)
    # Real flow on 80 x 60 pixels: a pixel is 5 cm wide at 3 m.
    assert exact["trajectory"]["ate"] < 0.04 and exact["cloud"]["chamfer"] < 0.05
    assert "true depth" in printed and "12 of 12" in printed
    for name in ("cloud_true_depth.ply", "cloud_true_depth.png", "cloud_base_model.png"):
        assert (tmp_path / name).stat().st_size > 1000
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/jpeg") == 3 and "ATE m" in page
    with (tmp_path / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * FRAMES and rows[5]["partners"] == "1 3"


def test_wrong_arguments_are_named(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")]
    for wrong, told in (
        (["--matcher", "x"], "'x' is unknown"),
        (["--start", "99"], "--start 99 is behind the last of 12 frames"),
        (["--sequence", "kitchen"], "no sequence 'kitchen'; there are"),
        (["--no-model", "--no-true-depth"], "nothing to reconstruct"),
    ):
        assert main(["reconstruct", str(room), *out, *wrong]) == 2
        assert told in capsys.readouterr().err
    assert main(["study", str(tmp_path / "nowhere"), *out]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_study_writes_figure_csv_and_json(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["study", str(room), "--out", str(tmp_path), "--frames", "2"]
    assert main([*words, "--factors", "0.5", "1", "2"]) == 0
    assert "AbsRel after alignment" in capsys.readouterr().out
    found = json.loads((tmp_path / "statistics_grid.json").read_text())
    assert (found["factors"], found["frames"]) == ([0.5, 1.0, 2.0], 2)
    assert found["scale"][1][1] == pytest.approx(1, abs=1e-3)
    with (tmp_path / "statistics_grid.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    assert float(rows[5]["scale"]) == found["scale"][1][2]
    assert cv2.imread(str(tmp_path / "statistics_grid.png")).std() > 20


BASES = {
    "moge2": small_moge2,
    "DA3MONO": lambda: small_da3("mono"),
    "DA3METRIC": lambda: small_da3("metric"),
}


@pytest.mark.parametrize("base", BASES)
def test_study_runs_on_todays_bases(
    base: str,
    room: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """At a = b = 1 nothing moves, to the solve's error; elsewhere scale or shift do."""
    monkeypatch.setattr(study, "load_model", load_model)
    save_model(BASES[base](), tmp_path / "base.safetensors")
    words = ["study", str(room), "--out", str(tmp_path), "--frames", "1", "--num-tokens", "12"]
    words += ["--model", str(tmp_path / "base.safetensors"), "--factors", "0.5", "1"]
    assert main(words) == 0
    found = json.loads((tmp_path / "statistics_grid.json").read_text())
    assert found["scale"][1][1] == pytest.approx(1, abs=3e-3)
    assert found["shift_over_median_depth"][1][1] == pytest.approx(0, abs=3e-3)
    assert found["abs_rel"][1][1] < 1e-3
    assert abs(found["scale"][1][0] - 1) > 0.02
    assert found["unmasked_frames"] == 0
    told = "affine_depth" if base == "DA3MONO" else "depth"
    assert f"base.safetensors ({told}), 1 frames of " in capsys.readouterr().out


def test_study_takes_a_hub_id_or_refuses_it(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(study, "load_model", load_model)
    content = {"model_config": moge2_config(), "model": small_moge2().state_dict()}
    torch.save(content, tmp_path / "model.pt")
    hub = fake_hub(monkeypatch, tmp_path, {"model.pt": tmp_path / "model.pt"})
    words = ["study", str(room), "--out", str(tmp_path), "--frames", "1", "--num-tokens", "12"]
    assert main([*words, "--factors", "1", "--model", "Ruicheng/moge-2-vits-normal"]) == 0
    assert "Ruicheng/moge-2-vits-normal (depth), 1 frames" in capsys.readouterr().out
    assert hub.downloads == ["model.pt"]
    assert main([*words, "--model", "depth-anything/DA3-LARGE"]) == 2
    assert "is Depth Anything 3 for several views" in capsys.readouterr().err
    assert hub.downloads == ["model.pt"]


def test_study_leaves_out_what_is_no_geometry() -> None:
    """A red half of the picture is a wall, the other half sky, whose values say nothing."""
    red = 0.4 + 0.2 * uniform(0, 1, 1, 12, 16)
    latent = Latent(torch.cat([red, 0 * red, 0 * red], 1), (12, 16), (12, 16))
    model = HalfSky().eval()
    grid = statistics_grid(model, [latent], (0.5, 1.0, 2.0))
    np.testing.assert_allclose(grid.scale, np.tile([2, 1, 0.5], (3, 1)), rtol=2e-3)
    assert grid.abs_rel.max() < 1e-4
    model.mask_threshold = 2.0
    assert grid.unmasked == 0
    assert statistics_grid(model, [latent], (1.0,)).unmasked == 1


class HalfSky(PinholeModel):
    """Its right half is no geometry and random at every call."""

    def decode(self, latent: Latent) -> AffinePoints:
        affine = super().decode(latent)
        half = affine.mask.shape[-1] // 2
        points, mask = affine.points.clone(), torch.ones_like(affine.mask)
        points[..., half:, 2] = torch.rand_like(points[..., half:, 2])
        mask[..., half:] = 0
        return AffinePoints(points, mask)


def test_a_linear_decoder_turns_statistics_into_scale_and_shift() -> None:
    """Depth = red + 0.5: with factors a, b the fit is 1 / b and what the mean moved by."""
    red = 0.4 + 0.2 * uniform(0, 1, 1, 12, 16)
    latent = Latent(torch.cat([red, 0 * red, 0 * red], 1), (12, 16), (12, 16))
    grid = statistics_grid(PinholeModel().eval(), [latent], (0.5, 1.0, 2.0))
    np.testing.assert_allclose(grid.scale, np.tile([2, 1, 0.5], (3, 1)), rtol=2e-3)
    mean, median = float(red.mean()), float(red.median()) + 0.5
    for row, a in enumerate(grid.factors):
        for column, b in enumerate(grid.factors):
            expected = (mean + 0.5) - (a * mean + 0.5) / b
            assert grid.shift[row, column] * median == pytest.approx(expected, abs=6e-3)
    assert grid.abs_rel.max() < 1e-4


def test_fuse_aligned_writes_figure_two(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reconstruct", str(room), "--out", str(tmp_path), "--fuse-aligned"]) == 0
    found = json.loads((tmp_path / "fusion.json").read_text())
    assert found["frames"] == FRAMES and set(found["runs"]) == {"with DyFN", "base model"}
    for alignments in found["runs"].values():
        frame, sequence = (alignments[f"per {unit}"] for unit in ("frame", "sequence"))
        assert frame["depth"]["abs_rel"] < sequence["depth"]["abs_rel"]
        assert frame["cloud"]["chamfer"] < sequence["cloud"]["chamfer"]
    printed = capsys.readouterr().out
    assert printed.count("per frame") == printed.count("per sequence") == 2
    assert cv2.imread(str(tmp_path / "fusion.png")).std() > 20
    assert (tmp_path / "cloud_true_depth.ply").stat().st_size > 1000
    assert (tmp_path / "cloud_base_model_per_sequence.ply").stat().st_size > 1000
    assert "AbsRel" in (tmp_path / "report.html").read_text()
    words = ["reconstruct", str(room), "--out", str(tmp_path), "--fuse-aligned", "--no-model"]
    assert main(words) == 2 and "--no-model" in capsys.readouterr().err


def test_fuse_aligned_leaves_out_frames_without_a_pose(room: Path, tmp_path: Path) -> None:
    poses = (room / "poses.txt").read_text().splitlines()
    other = tmp_path / "room"
    shutil.copytree(room, other)
    poses[3] = " ".join(["nan"] * 16)
    (other / "poses.txt").write_text("\n".join(poses))
    assert main(["reconstruct", str(other), "--out", str(tmp_path / "o"), "--fuse-aligned"]) == 3
    found = json.loads((tmp_path / "o/fusion.json").read_text())
    assert found["frames"] == FRAMES - 1 and list(found["losses"].values()) == [1]


def test_poses_of_partners_may_be_the_true_ones(room: Path, tmp_path: Path) -> None:
    words = ["reconstruct", str(room), "--out", str(tmp_path), "--offsets", "1", "3"]
    assert main([*words, "--matcher", "dis", "--max-frames", "4", "--poses", "true"]) == 0
    found = json.loads((tmp_path / "reconstruction.json").read_text())
    assert found["options"]["poses"] == "true"
    assert found["runs"]["true depth"]["trajectory"]["scale"] == pytest.approx(1, abs=0.1)
