"""Settings that come from environment variables."""

from __future__ import annotations

import os
from pathlib import Path


def model_folders() -> list[Path]:
    """Folders of bundles beside the package's own: POINTFILTER_MODEL_DIR."""
    folder = os.environ.get("POINTFILTER_MODEL_DIR")
    return [Path(folder)] if folder else []
