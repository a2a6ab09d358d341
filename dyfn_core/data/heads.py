"""What a file is by its first bytes when it is none of the data that it was taken for."""

from __future__ import annotations

from pathlib import Path

HEAD = 512  # bytes that are looked at
_ARCHIVES = {
    b"PK\x03\x04": "a zip archive",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive",
    b"Rar!": "a RAR archive",
    b"\x1f\x8b": "a gzip file",
    b"BZh": "a bzip2 file",
    b"\xfd7zXZ": "an xz file",
    b"\x04\x22\x4d\x18": "an lz4 file",
}
_LFS = b"version https://git-lfs"
_ANNEX = b"/annex/objects/"  # in the first line of the file, or of the link that it was
_MARKUP = (b"<!doctype", b"<html", b"<?xml", b"<head")
_TAR = (b"ustar", 257)


def told_by_head(path: Path, thing: str = "file") -> str:
    """What stands in the place of data, as the end of `it is ...`.

    Args:
        path: of the file.
        thing: what the file should be, for what to do.

    Returns:
        Such as "a zip archive: unpack it"; "" when the first bytes do not say, or there are none.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError:
        return ""
    for magic, text in _ARCHIVES.items():
        if head.startswith(magic):
            return f"{text}: unpack it"
    if head[_TAR[1] :].startswith(_TAR[0]):
        return "a tar archive: unpack it"
    if head.startswith(_LFS):
        return f"a Git LFS pointer: `git lfs pull` fetches the {thing}"
    if _ANNEX in head.split(b"\n")[0]:
        return f"a git-annex pointer: `git annex get` fetches the {thing}"
    if head.lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(_MARKUP):
        return f"a web page, it {beginning(head)}"
    return ""


def beginning(head: bytes) -> str:
    """The first bytes of a file as the end of a sentence about it."""
    text = head[:16]
    return f"begins with {text.decode('ascii')!r}" if text.isascii() else f"begins with {text!r}"
