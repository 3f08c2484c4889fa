"""`rtee info`: the description of a running hand, as a grasp planner needs it."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Annotated

import typer

from rtee.cli._common import ConnectOption, JsonOption, RunningOption
from rtee.cli._online import to_json, with_hand
from rtee.cli._table import Column, Row, TextTable

if TYPE_CHECKING:
    from rtee.remote.hand_info import HandInfo


def info(
    hand: RunningOption = None,
    connect: ConnectOption = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ACTUATOR=POSITION",
            help="Posture for the poses and Jacobians [rad | m]; may be repeated; else at rest.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Describe a running hand: limits and stiffness of actuators, tips with their friction.

    With --json also tip poses, Jacobians, the transmission and the URDF.
    """
    posture = dict(map(_position, at or ()))
    description = with_hand(hand, connect, "info", lambda remote: remote.info(posture))
    if as_json:
        print(to_json(dataclasses.asdict(description)))
    else:
        _show(description)


def _position(text: str) -> tuple[str, float]:
    name, equals, value = text.rpartition("=")
    try:
        position = float(value)
    except ValueError:
        position = math.nan
    if not equals or not name or not math.isfinite(position):
        raise typer.BadParameter(f"write ACTUATOR=POSITION, such as joint_1=0.5, not '{text}'")
    return name, position


def _show(description: HandInfo) -> None:
    counts = f"{len(description.actuators)} actuators, {len(description.joints)} joints"
    print(f"{description.name}: {counts}; base frame {description.base}\n")
    columns = ("actuator", "kind", "lower", "upper", "velocity", "effort", "stiffness", "fingers")
    numbers = columns[2:7]
    rows = [
        Row(
            (
                each.name,
                str(each.kind),
                *(_number(getattr(each, name)) for name in numbers),
                ", ".join(each.fingers),
            )
        )
        for each in description.actuators
    ]
    TextTable(tuple(Column(name, right=name in numbers) for name in columns), tuple(rows)).show()
    print("rad, rad/s, N·m, N·m/rad; of prismatic ones m, m/s, N, N/m\n")
    tips = [
        Row(
            (
                each.name,
                each.tip or "-",
                _number(each.friction),
                ""
                if each.tip_pose is None
                else ", ".join(f"{1e3 * value:.1f}" for value in each.tip_pose[:3, 3]),
                ", ".join(each.actuators),
            )
        )
        for each in description.fingers
    ]
    heads = ("finger", "tip", "friction", "tip at [mm]", "moved by")
    TextTable(tuple(Column(name, right=name == "friction") for name in heads), tuple(tips)).show()
    for sentence in description.missing:
        print(f"note: {sentence}")


def _number(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.4g}"
