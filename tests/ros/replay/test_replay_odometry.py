"""dyfn-replay --metric-source odometry: metres from the poses of a folder, scored as such."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, UNUSABLE
from tests.support.pinhole import FOV_X, PinholeModel
from tests.support.textured_plane import CAMERA, SIZE, plane_view, texture, walk

UNIT = 3.0  # metres in one unit of the model
FOCAL = SIZE[1] / 2 / np.tan(np.radians(FOV_X / 2))
OWN_CAMERA = np.array([[FOCAL, 0, CAMERA[0, 2]], [0, FOCAL, CAMERA[1, 2]], [0, 0, 1]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 frames at 10 Hz; red says the depth to PinholeModel, green has the texture."""
    path, whole = tmp_path_factory.mktemp("plane"), texture()
    for name in ("rgb", "depth"):
        (path / name).mkdir()
    np.savetxt(path / "K.txt", OWN_CAMERA)
    poses = walk(60, step=0.02, turn=0.002)
    np.savetxt(path / "poses.txt", np.stack(poses).reshape(-1, 16))
    for index, pose in enumerate(poses):
        view = plane_view(pose, whole, OWN_CAMERA)
        image = np.zeros((*SIZE, 3), np.uint8)
        image[..., 2] = np.round((view.depth / UNIT - 0.5) * 255)
        image[..., 1] = view.image[..., 1]
        cv2.imwrite(str(path / "rgb" / f"{index:05d}.png"), image)
        depth = np.round(view.depth * 1000).astype(np.uint16)
        cv2.imwrite(str(path / "depth" / f"{index:05d}.png"), depth)
    return path


def run(folder: Path, out: Path, *options: str) -> dict[str, Any]:
    fixed = ["--out", str(out), "--threads", "1", "--scene-cut-threshold", "0", "--write", "ply"]
    code = main([str(folder), *fixed, *options], lambda name, device: PinholeModel())
    assert code == ALL
    return json.loads((out / "metrics.json").read_text())


def test_poses_of_a_folder_give_metres(folder: Path, tmp_path: Path) -> None:
    found = run(folder, tmp_path, "--metric-source", "odometry", "--compare")
    assert found["metric"]["abs_rel"] < 0.05 and found["metric"]["delta1"] == 1.0
    assert found["metric_scale"]["unit"] == "metres"
    assert float(found["metric_scale"]["scale"]) == pytest.approx(UNIT, rel=0.05)
    # All frames are scored by the protocols that align, those before the metres as well.
    assert found["coverage"] == 1.0
    assert found["video"]["abs_rel"] < 0.05
    rows = (tmp_path / "frames.csv").read_text().splitlines()
    metric = rows[0].split(",").index("metric_abs_rel")
    known = [bool(row.split(",")[metric]) for row in rows[1:]]
    assert not any(known[:35]) and all(known[45:])


def test_noise_is_drawn_from_its_seed(folder: Path, tmp_path: Path) -> None:
    hashes = []
    for name, noise in (("a", "0.02,0.01,0.2,0"), ("b", "0.02,0.01,0.2,0"), ("c", "0,0.01,0.2,1")):
        options = ("--metric-source", "odometry", "--odometry-noise", noise)
        found = run(folder, tmp_path / name, *options)
        hashes.append(found["output_sha256"])
        assert found["metric"]["abs_rel"] < 0.08
    assert hashes[0] == hashes[1] != hashes[2]


def test_scale_error_of_the_odometry_is_the_depths(folder: Path, tmp_path: Path) -> None:
    options = ("--metric-source", "odometry", "--odometry-noise")
    plain = run(folder, tmp_path / "a", *options, "0,0,0,0")
    longer = run(folder, tmp_path / "b", *options, "0.1,0,0,0")
    ratio = float(longer["metric_scale"]["scale"]) / float(plain["metric_scale"]["scale"])
    assert ratio == pytest.approx(1.1, rel=0.02)


def test_metres_of_a_run_without_truth_are_the_cloud_s(folder: Path, tmp_path: Path) -> None:
    run(folder, tmp_path, "--metric-source", "odometry", "--depth-topic", "none")
    assert (tmp_path / "cloud.ply").exists()


def test_base_is_compared_without_odometry(folder: Path, tmp_path: Path) -> None:
    found = run(folder, tmp_path, "--metric-source", "odometry", "--compare")
    assert "metric" not in found.get("base", {})


def test_folder_without_poses_is_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("rgb", "depth", "K.txt"):
        (bare / name).symlink_to(folder / name)
    options = ["--metric-source", "odometry", "--out", str(tmp_path / "out"), "--threads", "1"]
    assert main([str(bare), *options], lambda name, device: PinholeModel()) == UNUSABLE
    assert "holds no poses.txt or groundtruth.txt" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--odometry-noise", "0,0,0,0"), "no effect without --metric-source odometry"),
        (("--odometry-topic", "/odom"), "no effect without --metric-source odometry"),
        (
            ("--metric-source", "odometry", "--odometry-noise", "2%"),
            "expected SCALE,DISTANCE,ROTATION,SEED such as 0.02,0.01,0.2,0: '2%'",
        ),
        (
            ("--metric-source", "odometry", "--odometry-noise", "0,-1,0,0"),
            "expected a scale above -1, and nothing else below 0",
        ),
    ],
)
def test_options_without_effect_and_bad_values_are_refused(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    expected: str,
) -> None:
    with pytest.raises(SystemExit):
        main([str(folder), "--out", str(tmp_path), *options])
    assert expected in capsys.readouterr().err
