"""What a camera shows of a hand in the tests: three bars, as far as three actuators are closed."""

from __future__ import annotations

from typing import Any

import numpy as np

HEIGHT, WIDTH = 48, 64


def picture(position: Any) -> Any:
    """Return the image ``(48, 64, 3)`` of positions [rad]."""
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    for channel, value in enumerate(np.clip(position[:3], 0.0, 2.0)):
        rows = slice(16 * channel, 16 * channel + 12)
        image[rows, : int(WIDTH * value / 2.0), channel] = 255
    return image
