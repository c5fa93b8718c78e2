"""Render the README's pictures anew: ``python docs/make_images.py``."""

from __future__ import annotations

from pathlib import Path

from warp_dvct import Relighter, usd_scenes
from warp_dvct.image import write_png
from warp_dvct.launch import Launcher
from warp_dvct.passes.tonemap import tonemap

FOLDER = Path(__file__).parent / "images"


def main() -> None:
    """Write the bundled room without and with the synthetic objects."""
    layers = Relighter(usd_scenes.path("room_area"), quality="high", width=640).render()
    for name, linear in (("before", layers.plate), ("after", layers.comp)):
        write_png(FOLDER / f"room_{name}.png", tonemap(Launcher("cpu"), linear))


if __name__ == "__main__":
    main()
