"""Touch in the GUI: taxels on the hand, sums over time, live and in a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import viser

from rtee.gui.history import TouchHistory
from rtee.gui.panels.plots import TouchPanel
from rtee.gui.playback import Playback
from rtee.gui.scene import HandScene, shades
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.log.recording import ActuatorSeries, JointSeries, Recording, TouchSeries
from rtee.sample import MEASURED
from rtee.touch import TouchSensor, TouchState

TIP = "left_inner_finger_pad"
PLACES = np.array([[0.0, -0.003, 0.0], [0.0, -0.003, 0.005]])
SENSORS = (
    TouchSensor("pad", 2, link=TIP, finger="finger_1", position=PLACES, normal=PLACES * 0.0),
    TouchSensor("skin", 1, unit="counts", full=4095.0),
)


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand("robotiq_2f_85")


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield made
    made.stop()


def state(*values: float, stamp: float = 1.0) -> TouchState:
    return TouchState("board", SENSORS, np.array(values), stamp)


def test_shades_go_from_nothing_to_the_largest_value() -> None:
    found = shades(np.array([0.0, 1.0, 2.0, 4.0, np.nan, -1.0]), 2.0).tolist()
    assert found[0] == found[4] == found[5] == 0
    assert found[2] == found[3] == 31
    assert 0 < found[1] < 31


def test_taxels_are_coloured_where_they_are(server: viser.ViserServer, hand: Hand) -> None:
    view = HandScene(server, hand).taxels
    view.show([state(0.0, 0.0, 0.0)])
    assert view.fingers == {"finger_1"}, "what has no place is not drawn"
    [cloud] = view._clouds.values()
    assert TIP in hand.urdf.links
    dark = cloud.colors.copy()
    assert (dark[0] == dark[1]).all()
    view.show([state(0.0, 3.0, 0.0)])
    assert (cloud.colors[0] == dark[0]).all()
    assert cloud.colors[1].sum() > dark[1].sum()
    view.show([state(0.0, 3.0, 0.0).outdated()])
    assert (cloud.colors[0] == cloud.colors[1]).all()
    assert len(set(cloud.colors[0].tolist())) == 1, "grey"
    view.show([])
    assert view.fingers == set()


def test_the_panel_has_a_plot_for_each_unit(server: viser.ViserServer) -> None:
    panel, past = TouchPanel(server.gui), TouchHistory()
    panel.draw(past.windows(panel.length))
    for k in range(5):
        past.add(state(0.5, 0.25 * k, 100.0, stamp=10.0 + k))
    windows = past.windows(panel.length)
    sensors, times, sums = windows["board"]
    assert sensors is SENSORS
    assert times.tolist() == [-4.0, -3.0, -2.0, -1.0, 0.0]
    assert sums[-1].tolist() == [1.5, 100.0]
    panel.draw(windows)
    assert list(panel._plots) == ["N", "counts"]
    assert panel._plots["N"].data[1][-1] == 1.5
    panel.show([state(0.5, 1.0, 7.0)])
    assert "pad" in panel._table.content
    assert "1.50" in panel._table.content
    # Other sensors than before: what they had measured is not mixed with it.
    other = replace(state(0.5, 1.0, 7.0, stamp=20.0), sensors=(SENSORS[0], SENSORS[1]))
    past.add(other)
    assert len(past.windows(10.0)["board"][1]) == 1


def test_a_recording_tells_what_was_felt_at_its_time(hand: Hand) -> None:
    t = np.array([0.0, 1.0, 2.0])
    wall, one = (t * 1e9).astype(np.int64), np.zeros((3, 1))
    series = JointSeries(t, wall, hand.actuator_names, one, one, one)
    states = ActuatorSeries(
        t=t,
        wall=wall,
        names=hand.actuator_names,
        **dict.fromkeys(MEASURED, one),
        tick=np.arange(3),
        time=t,
        grasped=np.zeros((3, 1), np.int8),
        fresh=np.ones((3, 1), bool),
    )
    values = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 2.0]])
    felt = TouchSeries("board", SENSORS, t[1:], wall[1:], t[1:], np.array([False, True]), values)
    recording = Recording((), hand.name, 0, int(2e9), True, {}, {}, series, states, series)
    playback = Playback(replace(recording, touch={"board": felt}), hand)
    assert playback.touch() == []
    playback.time = 2.0
    [last] = playback.touch()
    assert (last.of("pad").tolist(), last.stale) == ([1.0, 1.0], True)
    sensors, times, sums = playback.touch_windows(10.0)["board"]
    assert (sensors, times.tolist()) == (SENSORS, [1.0, 2.0])
    assert sums.tolist() == [[0.0, 1.0], [2.0, 2.0]]
