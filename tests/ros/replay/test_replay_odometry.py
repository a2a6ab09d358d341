"""dyfn-replay --metric-source odometry: metres from the poses of a folder, scored as such."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, UNUSABLE
from dyfn_ros.replay.run import ModelLoader
from tests.support.odometry import MOUNT, pose_text
from tests.support.pinhole import PinholeModel
from tests.support.plane_drive import UNIT, drive, plane_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return plane_folder(tmp_path_factory.mktemp("plane"))


def plain_model(name: str, device: str) -> PinholeModel:
    return PinholeModel()


def stabilized(name: str, device: str) -> PinholeModel:
    return PinholeModel(stabilized=True)


def run(folder: Path, out: Path, *options: str, model: ModelLoader = plain_model) -> dict[str, Any]:
    fixed = ["--out", str(out), "--threads", "1", "--scene-cut-threshold", "0", "--write", "ply"]
    code = main([str(folder), *fixed, *options], model)
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


def test_odometry_of_a_bag_gives_metres(folder: Path, tmp_path: Path) -> None:
    bag = drive(folder, tmp_path / "walk.mcap")
    options = ("--metric-source", "odometry", "--camera-pose", pose_text(MOUNT))
    found = run(bag, tmp_path / "out", *options)
    assert found["metric"]["abs_rel"] < 0.05
    assert found["odometry"]["frames"] == "base_link in odom"
    assert found["odometry"]["camera's place"] == "camera_pose"
    assert found["odometry"]["images with a pose"] == "60"


@pytest.mark.parametrize(
    ("offset", "options", "words"),
    [
        (77.0, ("--camera-pose", pose_text(MOUNT)), ("another clock", "77 s younger")),
        (0.0, (), ("'base_link'", "'camera_optical'", "set camera_pose")),
    ],
)
def test_odometry_that_cannot_be_used_is_named_and_depth_goes_on(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    offset: float,
    options: tuple[str, ...],
    words: tuple[str, ...],
) -> None:
    bag = drive(folder, tmp_path / "walk.mcap", offset)
    found = run(bag, tmp_path / "out", "--metric-source", "odometry", *options)
    warnings = capsys.readouterr().err
    assert found["coverage"] == 1.0 and found["metric_scale"]["unit"] == "relative"
    for word in ("/odom: images without a pose", "(60 times)", *words):
        assert word in warnings


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


def test_odometry_is_compared_with_none(folder: Path, tmp_path: Path) -> None:
    found = run(folder, tmp_path, "--metric-source", "odometry", "--compare")
    assert found["metric"] and "metric" not in found["base"]
    assert "base model with odometry" in (tmp_path / "report.html").read_text()


def test_odometry_is_compared_with_dyfn_alone_and_the_base(folder: Path, tmp_path: Path) -> None:
    plain = run(folder, tmp_path / "a", "--compare", model=stabilized)
    found = run(
        folder, tmp_path / "b", "--metric-source", "odometry", "--compare", model=stabilized
    )
    assert found["without_odometry"]["output_sha256"] == plain["output_sha256"]
    assert found["base"]["output_sha256"] == plain["base"]["output_sha256"]
    report = (tmp_path / "b" / "report.html").read_text()
    for name in ("with DyFN and odometry", "with DyFN", "base model"):
        assert f"dyfn-mini {name}" in report or f"dyfn-mini, {name}" in report


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
