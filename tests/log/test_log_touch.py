"""Touch in recordings: its messages, series, tables and plots, and what comes out again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.drivers.replay.driver import ReplayDriver
from rtee.errors import MessageError
from rtee.hand.model import Hand
from rtee.log import read
from rtee.log.check import check
from rtee.log.export import tables
from rtee.log.figure import figure
from rtee.log.plots import write_html, write_png
from rtee.loop.settings import LoopSettings
from rtee.messages.touch import TOUCH, TouchEncoder, sensors_fields, sensors_of, touch_of
from rtee.sample import ActuatorState
from rtee.touch import TouchReading, TouchSensor, TouchState
from rtee.types import DeviceSpec

from .test_log_check import RATE, make_hand, recorded, recording

pytestmark = pytest.mark.anyio

SENSORS = (
    TouchSensor(
        "thumb_pad",
        4,
        link="thumb_2",
        grid=(2, 2),
        position=np.arange(12.0).reshape(4, 3) / 1000.0,
        normal=np.tile([0.0, 0.0, 1.0], (4, 1)),
    ),
    TouchSensor("skin", 3, unit="counts", full=4095.0),
    TouchSensor("index_pad", link="index_2"),
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


class Taxels(KinematicDriver):
    """Feels something on the thumb's pad once that is closed a little; 50 readings a second."""

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.capabilities = replace(self.capabilities, touch=SENSORS)
        self._turn = 0
        self._reading: TouchReading | None = None

    async def sense(self) -> ActuatorState:
        state = await super().sense()
        if self._turn % round(RATE / 50.0) == 0:
            press = 0.1 if self.plants[2].position > 0.2 else 0.0
            counts = [self._turn % 4096, 0.0, 1.0]
            values = np.array([press, 2.0 * press, 3.0 * press, 0.3 * press, *counts, 0.0])
            self._reading = TouchReading(values, state.stamp)
        self._turn += 1
        return replace(state, touch=self._reading)


def state(values: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 5.0, 6.0, 7.0, 0.0)) -> TouchState:
    return TouchState("board", SENSORS, np.array(values), 12.5)


def test_a_message_holds_every_bit_and_the_layout_where_the_taxels_are() -> None:
    encoder = TouchEncoder()
    known = sensors_of(sensors_fields([state()]))
    for stale in (False, True):
        sent = replace(state([0.1 + 0.2, -0.0, 1e-300, 4.0, 5.0, 6.0, np.nan, 0.0]), stale=stale)
        data = encoder.encode(sent, 1_700_000_000_123_456_789)
        found = touch_of(TOUCH.decode(data), known)
        assert found.values.tobytes() == sent.values.tobytes()
        assert (found.device, found.stamp, found.stale) == ("board", 12.5, stale)
        assert found.sensors is known["board"]
        assert TOUCH.decode(data)["total"][0] == pytest.approx(sent.totals[0])
    assert known["board"][0].position.tolist() == SENSORS[0].position.tolist()
    assert [s.grid for s in known["board"]] == [(2, 2), None, None]
    # Whoever does not know the layout still has names, units and values.
    plain = touch_of(TOUCH.decode(data), {})
    assert [(s.name, s.unit, s.placed) for s in plain.sensors] == [
        ("thumb_pad", "N", False),
        ("skin", "counts", False),
        ("index_pad", "N", False),
    ]


@pytest.mark.parametrize(
    "wrong",
    [
        {"taxels": [4, 4, 1]},
        {"name": ["skin", "skin", "pad"]},
        {"unit": ["N"]},
        {"taxels": [7, 0, 1]},
    ],
)
def test_a_message_that_makes_no_sense_is_refused(wrong: dict[str, list[object]]) -> None:
    fields = TOUCH.decode(TouchEncoder().encode(state(), 0))
    with pytest.raises(MessageError, match="touch message"):
        touch_of(TOUCH.decode(TOUCH.encode(fields | wrong)), {})


@pytest.mark.heavy
async def test_a_run_with_taxels_is_recorded_and_comes_out_again(
    small: Hand, tmp_path: Path
) -> None:
    chosen = LoopSettings(rate=RATE)
    objects = {"index": 0.4, "thumb_base": 0.5}
    async with recording(small, tmp_path, chosen, kind=Taxels, objects=objects) as rig:
        result = await rig.do("PinchTight", "index", "thumb")
        assert result.grasped_fingers == ("thumb",)
        duration = len(rig.watcher.records) / RATE
    file = recorded(tmp_path)[0]
    found = read(file)
    [series] = found.touch.values()
    assert series.values.shape == (len(series), 8)
    assert len(series) == pytest.approx(50.0 * duration, abs=3.0), "at the device's rate"
    assert series.sensors[0].finger == "thumb"
    assert series.totals[-1, 0] == pytest.approx(0.63)
    assert not series.stale.any()
    report = check(found)
    assert report.same
    assert not check(replace(found, channels={})).results, "the taxels made the difference"
    # As a table and in a plot.
    table = tables(found, ["touch"])["touch"]
    assert set(table["sensor"]) == {"thumb_pad", "skin", "index_pad"}
    assert sorted({text.count(" ") for text in table["taxels"].tolist()}) == [0, 2, 3]
    told = [float(text) for texts in table["taxels"].tolist() for text in texts.split(" ")]
    assert sorted(told) == sorted(series.values.ravel().tolist()), "every bit is in it"
    assert set(table["wall_ns"]) == set(series.wall)
    drawn = figure(found)
    assert [row.unit for row in drawn.rows][-2:] == ["N", "counts"]
    assert drawn.rows[-2].positions[0].values.max() == pytest.approx(0.63)
    assert drawn.rows[-2].efforts[0].values.max() == pytest.approx(0.3)
    write_png(drawn, tmp_path / "plot.png")
    write_html(drawn, tmp_path / "plot.html")
    assert "touch: " in (tmp_path / "plot.html").read_text()
    await _replayed(small, file, series.values)


async def _replayed(hand: Hand, file: Path, values: np.ndarray) -> None:
    """Check that a device that plays the recording back gives the same readings."""
    spec = DeviceSpec("replay", hand.name, "replay", hand.actuators, {"file": str(file)}, RATE)
    driver = ReplayDriver(spec, BusPool())
    now = 100.0
    driver.now = lambda: now
    await driver.configure()
    assert [sensor.name for sensor in driver.capabilities.touch] == [
        "thumb_pad",
        "skin",
        "index_pad",
    ]
    assert driver.capabilities.touch[0].placed
    await driver.activate()
    readings: list[TouchReading] = []
    while not driver.ended:
        touch = (await driver.sense()).touch
        if touch is not None and (not readings or touch is not readings[-1]):
            readings.append(touch)
        now += 1.0 / RATE
    await driver.close()
    assert len(readings) == pytest.approx(len(values), abs=2)
    assert readings[-1].values.tobytes() == values[-1].tobytes()
