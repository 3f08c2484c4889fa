"""Make the pictures of the hands that come with rtee: each by itself, and a sheet of all.

Run it from the repository: ``python docs/pictures.py``. Each hand is shown on its way into its
Grasp, or into the action that moves most of its actuators. The pictures of the GUI have a script
of their own.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action, Timed
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.render.hand import HandRenderer
from rtee.sample import FloatArray

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "docs" / "assets"

CLOSURE = 0.55
"""How far each hand has closed: open enough to see the fingers, closed enough to see where to."""

SIZE = 480
"""Width and height that are rendered [pixels]; half of it is kept."""

COLUMNS = 5
CAPTION = 24
"""Height below each picture of the sheet, for its title [pixels]."""


def hands() -> list[Path]:
    """Return the folders of the hands in ``config/``."""
    return sorted(path.parent for path in (ROOT / "config").glob("*/hand.yaml"))


def shown_posture(hand: Hand, library: ActionLibrary) -> FloatArray:
    """Return the actuator positions in which a hand is shown ``(n,)`` [rad | m]."""
    actions = [action for action in library if not isinstance(action, Timed)]

    def rank(action: Action) -> tuple[bool, int]:
        return action.name == "Grasp", len(action.posture.involved)

    target = hand.rest.copy()
    if actions:
        posture = max(actions, key=rank).posture
        for name in posture.involved:
            target[hand.actuator_index(name)] = posture.position[name]
    return np.asarray(hand.rest + CLOSURE * (target - hand.rest))


def picture(folder: Path) -> tuple[str, Image.Image]:
    """Return the title of a hand and its picture."""
    hand = load_hand(folder)
    u = shown_posture(hand, ActionLibrary.load(hand, folder / "actions"))
    renderer = HandRenderer(hand, (SIZE, SIZE), postures=[u])
    with Image.open(io.BytesIO(renderer.picture(u))) as image:
        small = image.convert("RGB").resize((SIZE // 2, SIZE // 2), Image.Resampling.LANCZOS)
    return hand.description or hand.name, small


def main() -> None:
    """Write ``docs/assets/hands/NAME.png`` and ``docs/assets/hands.png``."""
    (ASSETS / "hands").mkdir(parents=True, exist_ok=True)
    folders, side = hands(), SIZE // 2
    rows = -(-len(folders) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * side, rows * (side + CAPTION)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for index, folder in enumerate(folders):
        title, small = picture(folder)
        small.quantize(128).save(ASSETS / "hands" / f"{folder.name}.png", optimize=True)
        x, y = index % COLUMNS * side, index // COLUMNS * (side + CAPTION)
        sheet.paste(small, (x, y))
        draw.text((x + side // 2, y + side + 4), title, "#333333", font, anchor="ma")
    sheet.quantize(256).save(ASSETS / "hands.png", optimize=True)


if __name__ == "__main__":
    main()
