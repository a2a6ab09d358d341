"""A Hub in memory, in the place of the functions of huggingface_hub that are used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import HfApi
from huggingface_hub.errors import EntryNotFoundError


class FakeHub:
    """One content for all repositories, and what was asked of them.

    files: name in the repository -> file here. asked: (address or name, keywords); a name stands
    for a download.
    """

    def __init__(self, files: dict[str, Path]) -> None:
        self.files = files
        self.asked: list[tuple[str, dict[str, Any]]] = []

    @property
    def downloads(self) -> list[str]:
        """Names of the files that were downloaded."""
        return [name for name, _ in self.asked if "/" not in name]

    def metadata(self, url: str, **options: Any) -> None:
        self.asked.append((url, options))
        if url.rpartition("/")[2] not in self.files:
            raise EntryNotFoundError("404")

    def download(self, repo_id: str, filename: str, **options: Any) -> str:
        self.asked.append((filename, options))
        return str(self.files[filename])


def fake_hub(monkeypatch: pytest.MonkeyPatch, folder: Path, files: dict[str, Path]) -> FakeHub:
    """A Hub in the place of the real one; nothing is in the cache, nor put by hand."""
    fake = FakeHub(files)
    monkeypatch.setenv("DYFN_MODELS", str(folder / "by_hand"))
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *_, **__: None)
    monkeypatch.setattr("huggingface_hub.get_hf_file_metadata", fake.metadata)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", fake.download)
    monkeypatch.setattr(HfApi, "list_repo_files", lambda *_, **__: list(fake.files))
    return fake
