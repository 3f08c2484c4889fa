"""Messages with the readings of touch sensors, and with the sensors of a hand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from rtee.errors import MessageError
from rtee.messages.cdr import SCALARS
from rtee.messages.codec import SECOND, header
from rtee.messages.layout import STAMP, Template, stamp_bytes
from rtee.messages.schema import message_type
from rtee.sample import FloatArray, TickRecord
from rtee.touch import TouchSensor, TouchState

TOUCH = message_type("rtee_msgs/msg/Touch")
TOUCH_SENSORS = message_type("rtee_msgs/msg/TouchSensors")

_TIME = SCALARS["float64"]
_CHANGING: Final = (STAMP, "time", "stale", "total", "value")

MOST_TAXELS: Final = 100_000
"""Most taxels accepted in a message: far more than any hand has; more are damage or malice."""

Sensors = tuple[TouchSensor, ...]


class TouchEncoder:
    """Encodes ``rtee_msgs/Touch``, with one template per device."""

    def __init__(self) -> None:
        self._templates: dict[str, tuple[Sensors, Template]] = {}

    def encode(self, state: TouchState, wall_ns: int) -> bytes:
        """Return the bytes of a message of readings, measured at a time since 1970 [ns].

        Raises `ValueError` if the values are not those of the sensors.
        """
        known = self._templates.get(state.device)
        # Compare by identity: the states of one device share their tuple of sensors.
        if known is None or known[0] is not state.sensors:
            known = state.sensors, Template(TOUCH, touch_fields(state), _CHANGING)
            self._templates[state.device] = known
        return known[1].filled(
            (
                stamp_bytes(wall_ns),
                _TIME.pack(state.stamp),
                b"\x01" if state.stale else b"\x00",
                state.totals.tobytes(),
                np.ascontiguousarray(state.values, dtype="<f8").tobytes(),
            )
        )


def touch_fields(state: TouchState, wall_ns: int = 0) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/Touch`` measured at a time since 1970 [ns]."""
    return {
        "header": header(wall_ns),
        "time": state.stamp,
        "device": state.device,
        "stale": state.stale,
        "name": [sensor.name for sensor in state.sensors],
        "unit": [sensor.unit for sensor in state.sensors],
        "taxels": [sensor.taxels for sensor in state.sensors],
        "total": state.totals,
        "value": state.values,
    }


def touch_of(fields: Mapping[str, Any], known: Mapping[str, Sensors]) -> TouchState:
    """Return the state in a decoded ``rtee_msgs/Touch``.

    The places of sensors that are not among the known ones stay unknown. Raises `MessageError` if
    the values do not fit the sensors.
    """
    names, units, taxels = fields["name"], fields["unit"], [int(n) for n in fields["taxels"]]
    values = fields["value"]
    if not len(names) == len(units) == len(taxels) or len(set(names)) != len(names):
        raise MessageError("each sensor of a touch message needs a name, a unit and a taxel count")
    if sum(taxels) != len(values) or min(taxels, default=1) < 1 or len(values) > MOST_TAXELS:
        raise MessageError("the values of a touch message do not fit its sensors")
    sensors = known.get(fields["device"], ())
    # `known` comes from an earlier message; the device may have been replaced since.
    if [(s.name, s.unit, s.taxels) for s in sensors] != list(
        zip(names, units, taxels, strict=True)
    ):
        sensors = tuple(map(TouchSensor, names, taxels, units))
    return TouchState(fields["device"], sensors, values, float(fields["time"]), fields["stale"])


def sensors_fields(states: Iterable[TouchState], wall_ns: int = 0) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/TouchSensors`` with the sensors of some devices."""
    sensors = [
        {
            "device": state.device,
            "name": sensor.name,
            "taxels": sensor.taxels,
            "unit": sensor.unit,
            "full": sensor.full,
            "link": sensor.link,
            "finger": sensor.finger,
            "grid": list(sensor.grid or ()),
            "position": sensor.position.ravel(),
            "normal": sensor.normal.ravel(),
        }
        for state in states
        for sensor in state.sensors
    ]
    return {"header": header(wall_ns), "sensors": sensors}


def sensors_of(fields: Mapping[str, Any]) -> dict[str, Sensors]:
    """Return the sensors of a decoded ``rtee_msgs/TouchSensors`` by device.

    Raises `MessageError` if the number of positions differs from the number of taxels.
    """
    by_device: dict[str, list[TouchSensor]] = {}
    for each in fields["sensors"]:
        grid = tuple(int(n) for n in each["grid"])
        if not 1 <= each["taxels"] <= MOST_TAXELS:
            raise MessageError(f"a touch sensor has {each['taxels']} taxels")
        if grid and (len(grid) != 2 or math.prod(grid) != each["taxels"]):
            raise MessageError("the grid of a touch sensor does not fit its taxels")
        sensor = TouchSensor(
            each["name"],
            int(each["taxels"]),
            each["unit"],
            float(each["full"]),
            each["link"],
            each["finger"],
            (grid[0], grid[1]) if grid else None,
            _rows(each["position"], each["taxels"]),
            _rows(each["normal"], each["taxels"]),
        )
        by_device.setdefault(each["device"], []).append(sensor)
    return {device: tuple(sensors) for device, sensors in by_device.items()}


def measured_at(record: TickRecord, state: TouchState) -> int:
    """Return the time of measurement of a state of a tick, since 1970 [ns]."""
    # Sensors are read between ticks; both stamps are those of the monotonic clock.
    return record.wall_ns - round((record.stamp - state.stamp) * SECOND)


def reply_fields(record: TickRecord) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/TouchReply`` with the touch sensors at a tick."""
    states = record.touch.values()
    return {
        "sensors": sensors_fields(states)["sensors"],
        "states": [touch_fields(state, measured_at(record, state)) for state in states],
    }


def reply_of(fields: Mapping[str, Any]) -> dict[str, TouchState]:
    """Return the states by device in a decoded ``rtee_msgs/TouchReply``.

    Raises `MessageError` if values or places do not fit the sensors.
    """
    known = sensors_of(fields)
    states = [touch_of(each, known) for each in fields["states"]]
    return {state.device: state for state in states}


def _rows(values: Sequence[float], taxels: int) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.size not in (0, 3 * taxels):
        raise MessageError("the places of a touch sensor do not fit its taxels")
    return array.reshape(-1, 3)
