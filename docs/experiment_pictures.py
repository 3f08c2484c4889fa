"""Make the pictures of the experiments' page from what the experiments wrote.

python docs/experiment_pictures.py [FROM] [TO]; FROM is logs/experiments unless given.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

NAMES = {
    "svh": ("schunk_svh.png", "schunk_svh_composed.png"),
    "wide_grasp": ("robotiq_3f_timed_wide_grasp.png", "robotiq_2f_140_Grasp.png"),
    "dagana_gui": ("dagana_gui.png",),
    "same_object": (
        "robotiq_2f_85_pick_and_place.png",
        "qb_softhand_pick_and_place.png",
        "onrobot_3fg15_pick_and_place.png",
    ),
    "heri_objects": ("heri_ii_PinchTight.png", "heri_ii_3f_grasp.png", "heri_ii_Grasp.png"),
    "drill": ("heri_ii_drill.png",),
}
"""The picture strips by experiment."""

PLOTTED = {
    "wide_grasp": "robotiq_3f",
    "dagana_gui": "dagana",
    "heri_objects": "heri_ii",
    "drill": "heri_ii",
}
"""Experiments of which a plot is shown, too, and the hand whose newest one it is."""

WIDTH = 1200
COLOURS = 256

SWEEPS = 4
"""Sweeps that improve the colours: without them, those of small fingers are merged."""


def small(source: Path, target: Path) -> None:
    """Write a picture no wider than the page, with few colours."""
    with Image.open(source) as picture:
        image = picture.convert("RGB")
    if image.width > WIDTH:
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.LANCZOS)
    few = image.quantize(COLOURS, kmeans=SWEEPS, dither=Image.Dither.NONE)
    few.save(target, optimize=True)


def main() -> None:
    """Make all pictures."""
    source = Path(sys.argv[1] if len(sys.argv) > 1 else "logs/experiments")
    target = Path(
        sys.argv[2] if len(sys.argv) > 2 else Path(__file__).parent / "assets" / "experiments"
    )
    target.mkdir(parents=True, exist_ok=True)
    for experiment, names in NAMES.items():
        for name in names:
            small(source / experiment / name, target / name)
        if experiment in PLOTTED:
            found = (source / experiment).glob(f"{PLOTTED[experiment]}_*.mcap")
            newest = max(found, key=lambda path: path.stat().st_mtime)
            small(newest.with_suffix(".png"), target / f"{experiment}_plot.png")


if __name__ == "__main__":
    main()
