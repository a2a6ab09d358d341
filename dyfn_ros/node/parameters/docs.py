"""`python -m dyfn_ros.node.parameters.docs`: the parameter table as the manual and its file."""

from __future__ import annotations

import sys
from pathlib import Path
from textwrap import wrap

from dyfn_ros.node.parameters.table import CONFIGURE, MARKS, RUN, START, Spec, groups, show

BEGIN = "<!-- parameters: written by `python -m dyfn_ros.node.parameters.docs` -->"
END = "<!-- end of parameters -->"
MANUAL, PARAMETER_FILE = Path("docs/node.md"), Path("config/stream_depth.yaml")
_WHEN = {START: "fixed at start", CONFIGURE: "while unconfigured", RUN: "at any time"}


def manual_tables() -> str:
    """Markdown: one table per group."""
    parts = []
    for name, specs in groups().items():
        rows = [_row(parameter, spec) for parameter, spec in specs.items()]
        parts.append("\n".join([f"| {name} | default | |", "| --- | --- | --- |", *rows]))
    return "\n\n".join(parts)


def _row(name: str, spec: Spec) -> str:
    own = " °" if spec.per_camera else ""
    return f"| `{name}`{MARKS[spec.changes]}{own} | {show(spec.default)} | {_text(spec)} |"


def _text(spec: Spec) -> str:
    limits = ""
    if spec.range:
        low, high = (f"{end:.10g}" for end in spec.range)
        limits = f" From {low} to {high}."
    return f"{spec.description}{limits}"


def parameter_file() -> str:
    """YAML: every parameter with its default and a comment."""
    lines = [
        "# Parameters of the node `stream_depth`, with their defaults; written by",
        "# `python -m dyfn_ros.node.parameters.docs`. A named camera may have its own:",
        "# `front.min_depth` for those marked (camera).",
        "# stream_depth --ros-args --params-file stream_depth.yaml",
        "/**/stream_depth:",
        "  ros__parameters:",
    ]
    for group, specs in groups().items():
        lines.append(f"    # --- {group} ---")
        for name, spec in specs.items():
            own = ", camera" if spec.per_camera else ""
            comment = f"({_WHEN[spec.changes]}{own}) {_text(spec)}"
            lines += [f"    # {line}" for line in wrap(comment, 92)]
            lines.append(f"    {name}: {show(spec.default)}")
    lines += [
        "    # QoS of any topic, by its resolved name:",
        "    # qos_overrides./stream_depth/depth/image.publisher.reliability: best_effort",
        "    # qos_overrides./image.subscription.depth: 1",
    ]
    return "\n".join(lines) + "\n"


def updated_manual(text: str) -> str:
    """The manual with the tables of now. Raises ValueError when it has no place for them."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{MANUAL} lacks {BEGIN!r} or {END!r}")
    return f"{before}{BEGIN}\n\n{manual_tables()}\n\n{END}{after}"


def main(root: Path = Path()) -> int:
    """Write both files under a source tree. -> exit code."""
    manual = root / MANUAL
    manual.write_text(updated_manual(manual.read_text(encoding="utf-8")), encoding="utf-8")
    (root / PARAMETER_FILE).write_text(parameter_file(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
