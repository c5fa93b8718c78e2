"""Pictures beside the rows of a sweep: composites and error maps as PNG, for the page to show."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_dvct.bench.references import Reference
from warp_dvct.errors import FileError
from warp_dvct.image import write_png
from warp_dvct.metrics import to_display

FOLDER = "pictures"
MAP_TOP = 0.3  # FLIP that is drawn brightest; errors of a usable composite are below


def save_pictures(out: Path, key: str, comp: np.ndarray, error_map: np.ndarray) -> None:
    """``pictures/KEY.png`` and its FLIP map ``pictures/KEY_flip.png``."""
    folder = _folder(out)
    write_png(folder / f"{key}.png", codes(to_display(comp)))
    write_png(folder / f"{key}_flip.png", codes(heat(error_map)))


def save_truth(out: Path, stage: str, truth: Reference) -> None:
    """``pictures/STAGE_truth.png`` and ``pictures/STAGE_before.png``."""
    folder = _folder(out)
    write_png(folder / f"{stage}_truth.png", codes(to_display(truth.comp)))
    write_png(folder / f"{stage}_before.png", codes(to_display(truth.before)))


def heat(error_map: np.ndarray) -> np.ndarray:
    """A FLIP map ``[h, w]`` as colours from black over red to white, 0.3 and more being white; ``[h, w, 3]``."""
    t = np.clip(np.asarray(error_map, np.float64) / MAP_TOP, 0.0, 1.0)[..., None]
    return np.clip(t * 3.0 - np.array([0.0, 1.0, 2.0]), 0.0, 1.0)


def codes(values: np.ndarray) -> np.ndarray:
    """[0, 1] to 8 bits."""
    return np.clip(np.asarray(values) * 255 + 0.5, 0, 255).astype(np.uint8)


def _folder(out: Path) -> Path:
    folder = out / FOLDER
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{folder} cannot be made: {error.strerror}; choose another folder with --out") from error
    return folder
