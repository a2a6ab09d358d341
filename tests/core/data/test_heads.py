"""What stands in the place of data is told by its first bytes."""

import tarfile
from pathlib import Path

import pytest

from dyfn_core.data.heads import told_by_head

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n"


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (LFS, "a Git LFS pointer: `git lfs pull` fetches the image"),
        (b"/annex/objects/SHA256E-s9--ab.png\n", "a git-annex pointer: `git annex get`"),
        (b"../../.git/annex/objects/Zz/1/SHA256E-s9--ab.png", "a git-annex pointer"),
        (b"PK\x03\x04rest", "a zip archive: unpack it"),
        (b"\x04\x22\x4d\x18rest", "an lz4 file: unpack it"),
        (b"\xef\xbb\xbf\n<!DOCTYPE html>", "a web page, it begins with"),
        (b'<?xml version="1.0"?><Error><Code>AccessDenied', "a web page, it begins with '<?xml"),
    ],
)
def test_it_is_told(tmp_path: Path, data: bytes, told: str) -> None:
    path = tmp_path / "0.png"
    path.write_bytes(data)
    assert told_by_head(path, "image").startswith(told)


def test_a_tar_archive_is_told(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    with tarfile.open(path, "w") as archive:
        archive.add(__file__, "walk.py")
    assert told_by_head(path) == "a tar archive: unpack it"


@pytest.mark.parametrize("data", [b"", b"\x89PNG\r\n\x1a\n", b"40 0 15.5\n", b"\x89MCAP0\r\n"])
def test_data_are_not(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "file").write_bytes(data)
    assert told_by_head(tmp_path / "file") == ""
    assert told_by_head(tmp_path / "none") == ""
