"""What `make docs` adds to the pages of docs/: the README and other pages that lie elsewhere.

Links are written for the repository. Here those to pages of the site follow their pages, and those
to other files of the repository become plain text, since the site does not have them.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
# Page of the site -> file of the repository.
OUTSIDE = {
    "index.md": "README.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "dyfn_core/weights/README.md": "dyfn_core/weights/README.md",
    "tests/golden/README.md": "tests/golden/README.md",
}
PAGE_OF = {source: page for page, source in OUTSIDE.items()}
LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside docs/."""
    for page, source in OUTSIDE.items():
        content = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, files: Files, **_: Any) -> str:
    """Turn the links of one page into links of the site."""
    uri = page.file.src_uri
    here = posixpath.dirname(OUTSIDE.get(uri, f"docs/{uri}"))

    def follow(link: re.Match[str]) -> str:
        path, hash_, anchor = link["target"].partition("#")
        if "://" in path or not path:
            return link[0]
        target = site_page(posixpath.normpath(posixpath.join(here, path)))
        if target is None or files.get_file_from_path(target) is None:
            return link["text"]
        target = posixpath.relpath(target, posixpath.dirname(uri) or ".")
        return f"{link['image']}[{link['text']}]({target}{hash_}{anchor})"

    return LINK.sub(follow, markdown)


def site_page(path: str) -> str | None:
    """The page or picture of the site for a path of the repository, if it has one."""
    if path in PAGE_OF:
        return PAGE_OF[path]
    return path.removeprefix("docs/") if path.startswith("docs/") else None
