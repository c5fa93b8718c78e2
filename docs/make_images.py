"""Render the README's pictures anew: ``python docs/make_images.py`` (truths take minutes of processor time once)."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

from warp_dvct import Relighter, usd_scenes
from warp_dvct.bench.error import LIT_STAGES, MANY_BOUNCES, ErrorOptions, measure
from warp_dvct.image import write_png
from warp_dvct.launch import Launcher
from warp_dvct.passes.tonemap import tonemap

FOLDER = Path(__file__).parent / "images"
GAP = 4  # pixels between the pictures of a row


def main() -> None:
    """Write the bundled room without and with the synthetic objects, and every lit stage beside its truth."""
    layers = Relighter(usd_scenes.path("room_area"), quality="high", width=640).render()
    for name, linear in (("before", layers.plate), ("after", layers.comp)):
        write_png(FOLDER / f"room_{name}.png", tonemap(Launcher("cpu"), linear))
    with tempfile.TemporaryDirectory() as made:
        options = ErrorOptions(width=320, samples=64, cache=usd_scenes.cache_folder() / "references", out=Path(made))
        for stage in LIT_STAGES:
            measure(stage, options)
            row([Path(made) / f"{stage}_{MANY_BOUNCES}_{kind}.png" for kind in ("comp", "truth", "flip")]).save(
                FOLDER / f"error_{stage}.jpg", quality=88
            )


def row(files: list[Path]) -> Image.Image:
    """Pictures of one size side by side on white."""
    pictures = [Image.open(file).convert("RGB") for file in files]
    width, height = pictures[0].size
    joined = Image.new("RGB", (len(files) * (width + GAP) - GAP, height), "white")
    for number, picture in enumerate(pictures):
        joined.paste(picture, (number * (width + GAP), 0))
    return joined


if __name__ == "__main__":
    main()
