"""What the GUI's plot of touch shows while a device is silent."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from rtee.gui.history import TouchHistory
from rtee.gui.panels.plots import TouchPanel


def state(device: str, stamp: float) -> Any:
    sensors = (SimpleNamespace(name=device.lower(), unit="N"),)
    return SimpleNamespace(device=device, stamp=stamp, sensors=sensors, totals=np.array([1.0]))


def test_a_silent_device_leaves_a_gap_in_the_plot() -> None:
    panel = TouchPanel.__new__(TouchPanel)
    past = TouchHistory()
    for k in range(5):
        for device in ("A", "B"):
            past.add(state(device, 100.0 + 0.1 * k))
    for k in range(120):
        past.add(state("B", 101.0 + 0.1 * k))
    found = panel._data(past.windows(10.0), "N")
    assert found is not None
