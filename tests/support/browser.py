"""A headless browser that looks at reports."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# WebGL on the CPU; no window, no network, no profile of the user.
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--virtual-time-budget=4000",
)
HARNESS = """<!doctype html><meta charset="utf-8"><body>{frames}<script>
window.addEventListener("load", function () {{
  var found = {{}};
  document.querySelectorAll("iframe").forEach(function (frame) {{
    var errors = [];
    try {{ found[frame.width] = (function (window, document) {{ {body} }})(
      frame.contentWindow, frame.contentDocument); }}
    catch (error) {{ found[frame.width] = {{ error: String(error) }}; }}
  }});
  document.title = JSON.stringify(found);
}});
</script></body>"""

# Elements that stand out of the window, and the widths of the page and of the window.
FITS = """
  var all = Array.from(document.querySelectorAll("body *"));
  var wide = all.filter(function (one) {
    var box = one.getBoundingClientRect();
    return box.width > 0 && box.right > window.innerWidth + 1 && !one.closest("svg");
  });
  var words = Array.from(document.querySelectorAll("th")).filter(function (one) {
    return one.scrollWidth > one.clientWidth;
  });
  var root = document.documentElement;
  var fit = { wide: wide.map(function (one) { return one.tagName + " " + one.className; }),
    words: words.map(function (one) { return one.textContent; }),
    page: root.scrollWidth, window: root.clientWidth };
"""


def assert_fits(seen: dict[str, Any]) -> None:
    """What FITS found of a page: nothing has to be scrolled sideways, at any width."""
    for width, fit in seen.items():
        assert fit.get("wide") == fit.get("words") == [], (width, fit)
        assert fit["page"] <= fit["window"] == int(width)


def look(page: Path, widths: Sequence[int], body: str, folder: Path) -> dict[str, Any]:
    """Open a page in windows of these widths; skips where there is no browser.

    body: JavaScript of a function of (window, document) that returns what was seen. Returns that,
    by width.
    """
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f"no browser to open the report in: none of {', '.join(NAMES)}")
    source = html.escape(page.read_text(encoding="utf-8"), quote=True)
    frames = "".join(
        f'<iframe width="{width}" height="900" srcdoc="{source}"></iframe>' for width in widths
    )
    harness = folder / "harness.html"
    harness.write_text(HARNESS.format(frames=frames, body=body), encoding="utf-8")
    profile = f"--user-data-dir={folder / 'profile'}"
    command = [browser, *OPTIONS, profile, "--dump-dom", f"file://{harness}"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    title = re.search(r"<title>(.*?)</title>", shown.stdout)
    assert title is not None, shown.stderr[-2000:]
    found: dict[str, Any] = json.loads(html.unescape(title.group(1)))
    return found
