"""Draws the pictures of docs/simulator.md: every world with the robot in it, and scenario 4 as an animation.

Usage: python -m benchmarks.world_pictures [--out docs]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from PIL import Image

from sim_backend import world as worlds
from sim_backend.world_picture import write_animation, write_picture

#: World, scenario and time in it, s.
SHOWN = (
    ("thesis", 1, 14.0),
    ("random:1", 3, 40.0),
    ("random:2", 4, 60.0),
    ("flooded", 1, 30.0),
    ("corridor", 2, 20.0),
    ("flat", 1, 20.0),
    ("tunnel", 1, 30.0),
    ("mine", 2, 600.0),
)
WIDTH = 900
COLUMNS = 2


def sheet(path: Path) -> None:
    """All worlds on one sheet."""
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for k, (name, scenario, time) in enumerate(SHOWN):
            file = Path(folder) / f"{k}.png"
            write_picture(worlds.load(name), scenario, "quasi-static", time, file, width=WIDTH)
            pictures.append(Image.open(file).convert("RGB"))
    height = pictures[0].height
    joined = Image.new("RGB", (COLUMNS * WIDTH, -(-len(pictures) // COLUMNS) * height), "white")
    for k, picture in enumerate(pictures):
        joined.paste(picture, (k % COLUMNS * WIDTH, k // COLUMNS * height))
    joined.quantize(256).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    out = parser.parse_args().out
    sheet(out / "worlds.png")
    write_animation(worlds.load("thesis"), 4, "quasi-static", out / "scenario-4.webp")


if __name__ == "__main__":
    main()
