"""Checks of `rtee doctor --ros2`: router, nodes, and nodes whose types do not match."""

from __future__ import annotations

from rtee.drivers.diagnosis.checks import Check, ok, warning, wrong
from rtee.errors import MissingExtra, NoRouter, install_line
from rtee.hand.config_schema import GripperUnit, Ros2Settings
from rtee.ros2 import Context
from rtee.ros2.listing import Listed, Sort, listed, unheard
from rtee.ros2.topics import ros_name

_ROUTER_REMEDY = "start it: ros2 run rmw_zenoh_cpp rmw_zenohd, or without ROS: rtee ros2 router"


_MOVEIT = ("moveit", "move_group")
"""Parts of the names of MoveIt's nodes, which send joint values to grippers by default."""


async def check_graph(settings: Ros2Settings, hand: str | None = None) -> list[Check]:
    """Return the checks of the ROS graph, and of a hand whose node should be there.

    rmw_zenoh is silent about nodes that use a topic, service or action with another type or hash:
    they do not receive each other's messages, without any warning. Raises `ConfigError` if a
    setting or variable of rmw_zenoh cannot be used.
    """
    try:
        # Insecure is harmless here, since this publishes and requests nothing.
        async with Context.open(settings, insecure=True, router_needed=True) as context:
            await context.graph.ready()
            rows = listed(context.graph.entities())
            checks = [ok("router", f"answers at {settings.router}, domain {context.domain}")]
    except MissingExtra as error:
        return [wrong("ROS 2", str(error), install_line(error.extra))]
    except NoRouter as error:
        return [wrong("router", str(error), _ROUTER_REMEDY)]
    nodes = [row.name for row in rows if row.sort is Sort.NODE]
    checks.append(ok("nodes", f"{len(nodes)}: {', '.join(sorted(nodes))}" if nodes else "none"))
    if hand is not None and not any(name.rpartition("/")[2] == hand for name in nodes):
        checks.append(
            warning("hand", f"there is no node '{hand}'", f"start it: rtee run {hand} --ros2")
        )
    checks += [
        check for row in rows if row.sort is Sort.ACTION for check in _gripper(row, settings, hand)
    ]
    checks += [
        wrong("types", sentence, "use the same distribution: 'ros2: distro' in hand.yaml")
        for sentence in unheard(rows)
    ]
    return checks


def _gripper(row: Listed, settings: Ros2Settings, hand: str | None) -> list[Check]:
    """Check whether a gripper's clients and the hand use the same unit of position."""
    if hand is None or not row.used or not row.name.endswith(f"/{ros_name(hand)}/gripper_cmd"):
        return []
    users = ", ".join(row.used)
    if settings.gripper_joint or settings.gripper is GripperUnit.MOVEIT:
        return [ok("gripper", f"{users}: positions are joint values, as from MoveIt")]
    moveit = [name for name in row.used if any(word in name for word in _MOVEIT)]
    if moveit:
        return [
            warning(
                "gripper",
                f"{', '.join(moveit)} seems to be MoveIt, which sends joint values;"
                " this hand takes positions as metres between the fingertips",
                "write 'ros2: {gripper: moveit}' in hand.yaml",
            )
        ]
    return [ok("gripper", f"{users}: positions are metres between the fingertips")]
