"""The reader of RGB-D folders: order, pairs, lists, intrinsics, and what it says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dyfn_core.data.files import read_colour
from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.rgbd.cameras import FolderCamera, published_camera, read_camera
from dyfn_core.data.rgbd.folder import RgbdFolder
from dyfn_core.data.rgbd.layouts import FolderOptions, find_folders, layout_of, open_folder
from dyfn_core.data.rgbd.names import frame_numbers, in_numeric_order, paired
from dyfn_core.data.rgbd.units import signs_of_another
from dyfn_core.geometry.rigid import quaternion_rotation, rigid
from tests.support.rgbd_folders import (
    MATRIX,
    SIZE,
    depth_frame_of,
    frame_of,
    metres,
    write,
    write_folder,
)

COUNT = 12
STAMPS = [1305031102.9 + 0.03125 * i for i in range(COUNT)]


def opened(folder: Path, options: FolderOptions | None = None) -> tuple[RgbdFolder, DataReport]:
    report = DataReport(str(folder))
    return open_folder(folder, report, options), report


def check(folder: RgbdFolder, count: int = COUNT) -> None:
    """Every frame is there, in order, with its own depth."""
    assert [frame_of(folder.image(frame)) for frame in folder.frames] == list(range(count))
    for number, frame in enumerate(folder.frames):
        depth = folder.depth(frame)
        assert depth is not None
        np.testing.assert_allclose(depth, metres(number), atol=6e-4)


NAMINGS = {
    "not padded": ("{}.jpg", "{}.png"),
    "padded": ("{:06}.png", "{:06}.png"),
    "prefixed": ("rgb_{:04}.png", "depth_{:04}.png"),
    "digits in the prefix": ("rgb8_{}.png", "depth16_{}.png"),
    "frame and kind": ("frame-{:06}.color.png", "frame-{:06}.depth.png"),
    "other padding": ("img{:05}.jpeg", "depth{}.png"),
    "upper case": ("{:06}.JPG", "{:06}.PNG"),
    "two numbers": ("scene12_{}.png", "scene12_{}.png"),
}


@pytest.mark.parametrize("naming", NAMINGS)
def test_frames_come_in_numeric_order_with_their_depth(naming: str, tmp_path: Path) -> None:
    colour, depth = NAMINGS[naming]
    write_folder(
        tmp_path, [colour.format(i) for i in range(COUNT)], [depth.format(i) for i in range(COUNT)]
    )
    folder, report = opened(tmp_path)
    check(folder)
    assert [frame.number for frame in folder.frames] == list(range(COUNT))
    assert not report.problems


def test_times_as_names_are_ordered_by_value_over_a_full_second(tmp_path: Path) -> None:
    names = [f"{stamp:.6f}.png" for stamp in STAMPS]
    assert sorted(names, key=lambda name: int(name.split(".")[1])) != names
    write_folder(tmp_path, names, names)
    folder, _ = opened(tmp_path)
    check(folder)
    assert [frame.number for frame in folder.frames] == list(range(COUNT))  # no frame numbers


def test_missing_numbers_stay_gaps_and_nanoseconds_are_none() -> None:
    files = in_numeric_order(Path(f"{n}.png") for n in (80, 100, 90))
    assert [path.stem for path in files] == ["80", "90", "100"]
    assert frame_numbers(files) == [80, 90, 100]
    assert frame_numbers([Path(f"14036365797{i}3555584.png") for i in range(3)]) == [0, 1, 2]
    assert frame_numbers([Path("a.png"), Path("b.png")]) == [0, 1]


def test_files_that_are_alike_in_a_rule_are_not_paired_by_it() -> None:
    images = [Path(f"rgb/{i}_640.png") for i in range(3)]
    depths = [Path(f"depth/d{i}_640.png") for i in range(3)]
    assert paired(images, depths) == dict(zip(images, depths, strict=True))
    assert paired([Path("a_1.png"), Path("b_1.png")], [Path("c_1.png")]) == {}


def test_what_has_no_partner_and_what_is_not_read_is_counted(tmp_path: Path) -> None:
    write_folder(tmp_path, [f"{i}.png" for i in range(4)], [f"{i}.png" for i in range(3)])
    (tmp_path / "depth" / "1.png").unlink()
    write(tmp_path / "depth" / "77.png", np.ones(SIZE, np.uint16))
    for name in ("depth/0.tiff", "depth/1.npy", "rgb/0.webp", "rgb/times.txt"):
        (tmp_path / name).write_bytes(b"x")
    folder, report = opened(tmp_path)
    assert [frame.depth is None for frame in folder.frames] == [False, True, False, True]
    told = {reason: len(names) for reason, names in report.problems.items()}
    assert told == {
        "image without depth": 2,
        "depth without image": 1,
        ".tiff file in depth/ that is not read (.png are)": 1,
        ".npy file in depth/ that is not read (.png are)": 1,
        ".webp file in rgb/ that is not read (.jpg, .jpeg, .png are)": 1,
    }
    with pytest.raises(FrameError, match=r"1\.png: has no depth"):
        folder.registered(folder.frames[1])


def test_a_folder_of_colour_alone_has_nothing_to_say(tmp_path: Path) -> None:
    write_folder(tmp_path, ["0.png", "1.png"], [])
    folder, report = opened(tmp_path)
    assert len(folder.frames) == 2 and not folder.with_depth and not report.problems


def test_hidden_companions_are_not_seen(tmp_path: Path) -> None:
    write_folder(tmp_path / "walk", ["0.png", "1.png"], ["0.png", "1.png"])
    for name in ("rgb/._0.png", "rgb/.DS_Store", "depth/._0.png", "._K.txt"):
        (tmp_path / "walk" / name).write_bytes(b"\0\5\x16\7")
    np.savetxt(tmp_path / "walk" / "poses.txt", [np.eye(4).ravel()] * 2)
    for companion in (".Trash/rgb", "__MACOSX/rgb"):
        (tmp_path / companion).mkdir(parents=True)
    assert list(find_folders(tmp_path, 2)) == [tmp_path / "walk"]
    folder, report = opened(tmp_path / "walk")
    check(folder, 2)
    assert not report.problems
    assert all(frame.pose is not None for frame in folder.frames)


def write_lists(folder: Path, lists: dict[str, list[str]], bom: bool = False) -> None:
    for name, lines in lists.items():
        text = "\n".join(["# a comment", *lines]) + "\n"
        (folder / f"{name}.txt").write_text(text, "utf-8-sig" if bom else "utf-8")


@pytest.mark.parametrize("bom", [False, True])
def test_lists_say_what_belongs_together_and_when(tmp_path: Path, bom: bool) -> None:
    """Same names in both folders: only the lists tell that depth is stored 5000 a metre."""
    names = [f"{stamp:.6f}.png" for stamp in STAMPS]
    write_folder(tmp_path, names, names, unit=5000)
    backwards = list(zip(STAMPS, names, strict=True))[::-1]
    lists = {kind: [f"{t:.6f} {kind}/{name}" for t, name in backwards] for kind in ("rgb", "depth")}
    write_lists(tmp_path, lists, bom)
    folder, report = opened(tmp_path)
    check(folder)
    assert [frame.stamp for frame in folder.frames] == pytest.approx(STAMPS, abs=1e-6)
    assert list(report.problems) == ["folder without groundtruth.txt (its frames have no poses)"]


def test_an_offset_between_the_lists_is_taken_away(tmp_path: Path) -> None:
    names = [f"{i}.png" for i in range(COUNT)]
    write_folder(tmp_path, names, names, unit=5000)
    lists = {
        kind: [f"{t + late:.6f} {kind}/{name}" for t, name in zip(STAMPS, names, strict=True)]
        for kind, late in (("rgb", 0.0), ("depth", -41.25))
    }
    write_lists(tmp_path, lists)
    folder = open_folder(tmp_path, DataReport("test"), FolderOptions(depth_offset=-41.25))
    check(folder)
    report = DataReport("test")
    assert not open_folder(tmp_path, report).with_depth
    assert report.problems["image without depth within 0.02 s"] == [
        str(tmp_path / "rgb" / name) for name in names
    ]
    (tmp_path / "rgb.txt").unlink()
    with pytest.raises(DataError, match="an offset of depth in time"):
        open_folder(tmp_path, report, FolderOptions(depth_offset=-41.25))


@pytest.mark.parametrize("depth_first", [False, True])
@pytest.mark.parametrize("name", ["associations", "associate"])
def test_associations_alone(tmp_path: Path, depth_first: bool, name: str) -> None:
    """ICL-NUIM counts its frames and names depth first, TUM's script has stamps, colour first."""
    names = [f"{i}.png" for i in range(COUNT)]
    write_folder(tmp_path, names, names, unit=5000)
    lines = []
    for index, stamp in enumerate(STAMPS):
        pair = [f"{stamp:.6f} rgb/{index}.png", f"{stamp + 0.01:.6f} depth/{index}.png"]
        counted = [f"{index} rgb/{index}.png", f"{index} depth/{index}.png"]
        lines.append(" ".join(counted[::-1] if depth_first else pair))
    write_lists(tmp_path, {name: lines[::-1]})
    folder, report = opened(tmp_path)
    check(folder)
    stamps = [frame.stamp for frame in folder.frames]
    assert stamps == ([None] * COUNT if depth_first else pytest.approx(STAMPS, abs=1e-6))
    assert not report.problems
    write_lists(tmp_path, {name: lines[3:]})
    _, report = opened(tmp_path)
    assert {r: len(n) for r, n in report.problems.items()} == {
        f"picture that {name}.txt does not name": 3
    }


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "associations",
            "0 rgb/0.png 0\n",
            "expected lines of `stamp file stamp file`",
        ),
        ("associations", "0 rgb/0.png 0 rgb/0.png\n", "to name `depth`"),
        ("associations", "x rgb/0.png 0 depth/0.png\n", "expected a stamp in seconds in 'x rgb"),
        ("rgb", "0.5\n", r"rgb\.txt: expected lines of `stamp file`, got '0\.5'"),
        ("rgb", "0.5 rgb/0.png\n", r"depth\.txt: cannot be read"),
    ],
)
def test_a_wrong_list_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    write_folder(tmp_path, ["0.png"], ["0.png"])
    (tmp_path / f"{name}.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        opened(tmp_path)


def test_the_layout_of_other_folders_is_none(tmp_path: Path) -> None:
    (tmp_path / "rgb").write_text("a file")
    (tmp_path / "color").mkdir()
    assert layout_of(tmp_path) is None and layout_of(tmp_path / "rgb") is None
    with pytest.raises(DataError, match=r"expected one of: rgb\.txt and depth\.txt"):
        opened(tmp_path)


WRITTEN = {
    "three rows": "60 0 31.5\n0 60 23.5\n0 0 1\n",
    "BOM and commas": "\ufeff60, 0, 31.5\n0, 60, 23.5\n0, 0, 1\n",
    "brackets": "[[60 0 31.5]\n [0 60 23.5]\n [0 0 1]]",
    "four rows": "60 0 31.5 0\n0 60 23.5 0\n0 0 1 0\n0 0 0 1\n",
    "one line of nine": "60 0 31.5 0 60 23.5 0 0 1",
    "four numbers": "# fx fy cx cy\n60 60 31.5 23.5 # pixels\n",
}


@pytest.mark.parametrize("form", WRITTEN)
def test_intrinsics_are_read_in_every_form(form: str, tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text(WRITTEN[form], "utf-8")
    assert read_camera(tmp_path / "K.txt").at(SIZE) == (60, 60, 31.5, 23.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0\n0 0 0\n0 0 0", "focal lengths above 0"),
        ("nan 0 31.5\n0 60 23.5\n0 0 1", "expected finite numbers"),
        ("60 0 31.5\n0 -60 23.5\n0 0 1", "focal lengths above 0"),
        ("60 0 0\n0 60 0\n31.5 23.5 1", "transposed"),
        ("60 9 31.5\n0 60 23.5\n0 0 1", "without skew"),
        ("60 0 31.5\n0 60 23.5", "got 6 numbers"),
        ("fx fy cx cy", "could not convert"),
    ],
)
def test_unusable_intrinsics_are_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text(text)
    with pytest.raises(DataError, match=rf"K\.txt: .*{message}"):
        read_camera(tmp_path / "K.txt")


@pytest.mark.parametrize(
    "pixels", [(1800, 1800, 959.5, 539.5), (0.94, 1.25, 0.5, 0.5), (60, 700, 31.5, 23.5)]
)
def test_intrinsics_of_other_images_are_refused(
    pixels: tuple[float, float, float, float], tmp_path: Path
) -> None:
    write_folder(tmp_path, ["0.png"], ["0.png"])
    (tmp_path / "K.txt").write_text(" ".join(map(str, pixels)))
    folder, _ = opened(tmp_path)
    with pytest.raises(DataError, match=r"K\.txt: fx=.*images of 64 x 48"):
        folder.check_camera()
    given, _ = opened(tmp_path, FolderOptions(intrinsics=(60, 60, 31.5, 23.5)))
    given.check_camera()
    assert given.camera_at(SIZE) == (60, 60, 31.5, 23.5)


def test_published_intrinsics_are_scaled_to_the_images_and_a_file_goes_before_them() -> None:
    camera = published_camera(Path("/data/rgbd_dataset_freiburg1_desk"))
    assert camera is not None
    assert camera.at((480, 640)) == (517.3, 516.5, 318.6, 255.3)
    assert camera.at((240, 320)) == pytest.approx((258.65, 258.25, 159.05, 127.4))
    with pytest.raises(FrameError, match="of 640 x 480 pixels, but the images have 640 x 360"):
        camera.at((360, 640))
    assert published_camera(Path("/data/desk")) is None
    here = FolderCamera((60, 60, 31.5, 23.5), "K.txt")
    assert here.at((48, 64)) == here.pixels


def test_a_camera_file_goes_before_the_published_one(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "freiburg1", ["0.png"], ["0.png"], unit=5000)
    write_lists(folder, {"rgb": ["0.5 rgb/0.png"], "depth": ["0.5 depth/0.png"]})
    found, _ = opened(folder)
    assert found.camera_at(SIZE) == (MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2])
    (folder / "K.txt").unlink()
    found, _ = opened(folder)
    camera = found.camera_at(SIZE)
    assert camera is not None and camera[0] == pytest.approx(51.73)
    frame = found.read(found.frames[0])
    assert depth_frame_of(frame.depth) == 0 and frame.stamp == 0.5
    assert re.search("freiburg1", found.camera.source if found.camera else "")


def write_seven_scenes(folder: Path) -> np.ndarray:
    """One frame of 640 x 480; depth rises by 1 mm a column, from 1 m. -> the stored depth."""
    folder.mkdir(exist_ok=True)
    stored = np.tile(1000 + np.arange(640, dtype=np.uint16), (480, 1))
    write(folder / "frame-000000.color.png", np.zeros((480, 640, 3), np.uint8))
    write(folder / "frame-000000.depth.png", stored)
    np.savetxt(folder / "frame-000000.pose.txt", np.eye(4))
    return stored


def test_seven_scenes_depth_is_laid_over_the_colour_image(tmp_path: Path) -> None:
    """A ray's column is 320 + 525 x / z in colour and 320 + 585 x / z in depth."""
    write_seven_scenes(tmp_path)
    folder, _ = opened(tmp_path)
    assert folder.camera is not None and folder.camera.pixels == (525, 525, 320, 240)
    depth = folder.depth(folder.frames[0])
    assert depth is not None
    for column in (40, 320, 600):
        there = round(320 + (column - 320) * 585 / 525)
        assert depth[240, column] == pytest.approx(1 + there / 1000, abs=1e-6)
    assert np.isnan(depth[:, :32]).all() and np.isnan(depth[:24]).all()
    assert np.isfinite(depth[30:-30, 35:-35]).all()


def test_depth_of_a_folder_with_its_own_camera_stays_where_it_is(tmp_path: Path) -> None:
    stored = write_seven_scenes(tmp_path)
    np.savetxt(tmp_path / "K.txt", [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    folder, _ = opened(tmp_path)
    depth = folder.depth(folder.frames[0])
    np.testing.assert_allclose(depth, stored / 1000, atol=1e-6)
    given, _ = opened(tmp_path, FolderOptions(intrinsics=(510, 510, 320, 240)))
    np.testing.assert_allclose(given.depth(given.frames[0]), stored / 1000, atol=1e-6)


POSES = [
    rigid(quaternion_rotation(0.9, 0.1, -0.3, 0.2), np.array([i, 2.0, -1.0])) for i in (0, 1, 2)
]
TUM_ROWS = [[50 + i, i, 2.0, -1.0, 0.1, -0.3, 0.2, 0.9] for i in (0, 1, 2)]


@pytest.mark.parametrize(
    "rows",
    [
        [pose.ravel() for pose in POSES],
        [pose[:3].ravel() for pose in POSES],  # KITTI
        np.concatenate(POSES),
        np.concatenate([pose[:3] for pose in POSES]),
        TUM_ROWS,
    ],
    ids=["4 x 4", "3 x 4", "lines of 4 x 4", "lines of 3 x 4", "TUM"],
)
def test_poses_are_read_in_every_common_form(rows: list[np.ndarray], tmp_path: Path) -> None:
    write_folder(tmp_path, [f"{i}.png" for i in range(3)], [f"{i}.png" for i in range(3)])
    np.savetxt(tmp_path / "poses.txt", rows)
    folder, report = opened(tmp_path)
    assert not report.problems
    np.testing.assert_allclose([frame.pose for frame in folder.frames], POSES, atol=1e-9)


@pytest.mark.parametrize("columns", [7, 6, 2])
def test_poses_of_another_form_are_refused(columns: int, tmp_path: Path) -> None:
    """24 lines of 2 numbers would be 3 poses by their count alone."""
    write_folder(tmp_path, [f"{i}.png" for i in range(3)], [f"{i}.png" for i in range(3)])
    np.savetxt(tmp_path / "poses.txt", np.ones((24, columns)))
    with pytest.raises(DataError, match=rf"poses.txt: expected .* got 24 lines of {columns}"):
        opened(tmp_path)


def test_a_row_that_is_no_pose_leaves_the_frame_without_one(tmp_path: Path) -> None:
    write_folder(tmp_path, [f"{i}.png" for i in range(3)], [f"{i}.png" for i in range(3)])
    rows = np.array(TUM_ROWS)
    rows[1, 4:] = 0
    np.savetxt(tmp_path / "poses.txt", rows)
    folder, report = opened(tmp_path)
    assert [frame.pose is None for frame in folder.frames] == [False, True, False]
    assert report.problems == {
        "pose that is none (the frame stays)": [f"{tmp_path / 'poses.txt'} row 1"]
    }


def test_a_projection_matrix_is_a_camera(tmp_path: Path) -> None:
    """P of a CameraInfo; its fourth column is the place of a second camera."""
    projection = np.column_stack([MATRIX, [-0.12, 0, 0]])
    np.savetxt(tmp_path / "K.txt", projection)
    found = read_camera(tmp_path / "K.txt").pixels
    assert found == pytest.approx([MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2]])


def test_a_picture_that_git_lfs_did_not_fetch_is_told_so(tmp_path: Path) -> None:
    write_folder(tmp_path, ["0.png"], ["0.png"])
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 7\n"
    (tmp_path / "depth" / "0.png").write_text(pointer)
    folder, _ = opened(tmp_path)
    with pytest.raises(FrameError, match="Git LFS pointer: `git lfs pull`"):
        folder.depth(folder.frames[0])


def test_pixels_stay_as_stored_whatever_exif_says(tmp_path: Path) -> None:
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:4] = 255
    picture = Image.fromarray(pixels)
    tags = picture.getexif()
    tags[0x0112] = 3  # upside down
    picture.save(tmp_path / "0.jpg", exif=tags, quality=100)
    np.testing.assert_allclose(read_colour(tmp_path / "0.jpg"), pixels, atol=3)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("cam_params.json", '{"camera": {"scale": 6553.5}}', 'scale": 6553.5'),
        (
            "config.yaml",
            "cam:\n  png_depth_scale: 5000.0 # here\n",
            "png_depth_scale: 5000.0",
        ),
        ("orb.yaml", "DepthMapFactor: 5000.0\n", "DepthMapFactor: 5000.0"),
        ("a.json", '{"depth_scale": 1000.0}', ""),
        ("a.json", '{"depth_scale": 0.001}', ""),
        ("a.json", '{"grayscale": 7, "scaled": 3, "scale": true}', ""),
    ],
)
def test_another_scale_beside_is_said(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    found = [*signs_of_another(tmp_path, [tmp_path / "rgb/0.png"])]
    assert found == ([f"{name} says {said!r}, which may be of the depth"] if said else [])


def test_redwoods_names_pair_by_their_microseconds() -> None:
    images = [Path(f"{number:07d}-{33_333 * number:012d}.jpg") for number in range(4)]
    depths = [Path(f"{number + 1:07d}-{33_333 * number + 9000:012d}.png") for number in range(4)]
    assert paired(images, depths) == dict(zip(images, depths, strict=True))
    assert paired(images, [Path(f"{n:07d}-{33_333 * n + 25_000:012d}.png") for n in (9, 10)]) == {}
