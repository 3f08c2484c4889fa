"""Make the pictures of the README and the documentation: every hand in its Grasp.

Run it from the repository: ``python docs/pictures.py``. The pictures of the GUI have a script of
their own.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Timed
from rtee.hand.catalog import find_hand
from rtee.hand.load import load_hand
from rtee.render.hand import render_hand

ASSETS = Path(__file__).with_name("assets")
HANDS = (
    ("schunk_svh", "SCHUNK SVH"),
    ("heri_ii", "HERI II"),
    ("qb_softhand", "qb SoftHand"),
    ("robotiq_3f", "Robotiq 3-Finger"),
    ("robotiq_2f_85", "Robotiq 2F-85"),
    ("robotiq_2f_140", "Robotiq 2F-140"),
    ("onrobot_3fg15", "OnRobot 3FG15"),
    ("dagana", "Dagana"),
)
CLOSURE = 0.55
SIZE = (480, 480)
COLUMNS = 4


def picture(name: str) -> Image.Image:
    """Render a hand on its way into its Grasp."""
    hand = load_hand(name)
    library = ActionLibrary.load(hand, find_hand(name) / "actions")
    action = library.find("Grasp")
    assert not isinstance(action, Timed)
    grasp = np.array([action.posture.position[a] for a in hand.actuator_names])
    u = hand.rest + CLOSURE * (grasp - hand.rest)
    return Image.open(io.BytesIO(render_hand(hand, u, SIZE)))


def main() -> None:
    """Write docs/assets/hands.png."""
    rows = -(-len(HANDS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * SIZE[0] // 2, rows * (SIZE[1] // 2 + 24)), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(15)
    for index, (name, title) in enumerate(HANDS):
        column, row = index % COLUMNS, index // COLUMNS
        x, y = column * SIZE[0] // 2, row * (SIZE[1] // 2 + 24)
        small = picture(name).convert("RGB").resize((SIZE[0] // 2, SIZE[1] // 2), Image.LANCZOS)
        sheet.paste(small, (x, y))
        draw.text((x + SIZE[0] // 4, y + SIZE[1] // 2 + 4), title, "#333333", font, anchor="ma")
    ASSETS.mkdir(exist_ok=True)
    sheet.save(ASSETS / "hands.png", optimize=True)


if __name__ == "__main__":
    main()
