"""Where exported parts of models are kept."""

from __future__ import annotations

import os
from pathlib import Path


def export_folder() -> Path:
    """$DYFN_EXPORTS or ~/.cache/dyfn/exports."""
    chosen = os.environ.get("DYFN_EXPORTS")
    return Path(chosen) if chosen else Path.home() / ".cache" / "dyfn" / "exports"
