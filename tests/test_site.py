"""The manual as a site: every page is in its menu, and it builds without a warning."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]


def pages_of(menu: Any) -> Iterator[str]:
    for entry in menu:
        (target,) = entry.values()
        yield from [target] if isinstance(target, str) else pages_of(target)


def test_every_page_is_in_the_menu() -> None:
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = list(pages_of(config["nav"]))
    assert len(listed) == len(set(listed))
    docs = ROOT / "docs"
    written = {str(path.relative_to(docs)) for path in docs.rglob("*.md")}
    unlisted = {path for path in written - set(listed) if not path.startswith("history/")}
    assert unlisted == set()


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    # Not --quiet: it hides the warnings from `strict` too.
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stderr[-3000:]
    first = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert 'href="quickstart/robot.html"' in first and 'href="metric_scale.html"' in first
    card = (tmp_path / "dyfn_core/weights/index.html").read_text(encoding="utf-8")
    assert "dyfn-mini" in card
    assert "camera_matrix" in (tmp_path / "api.html").read_text(encoding="utf-8")
