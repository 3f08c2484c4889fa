"""rtee: command any robotic hand or gripper by grasping actions.

Example:
    async with rtee.connect("schunk_svh") as hand:
        result = await hand.do("pinch_tight", "index", "thumb", intensity=0.6)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtee.hand.load import load_hand
    from rtee.planning.plan import grasp_plan
    from rtee.remote.blocking import connect_blocking
    from rtee.remote.client import connect

__all__ = ["connect", "connect_blocking", "grasp_plan", "load_hand"]

_HOME = {
    "connect": "rtee.remote.client",
    "connect_blocking": "rtee.remote.blocking",
    "grasp_plan": "rtee.planning.plan",
    "load_hand": "rtee.hand.load",
}


def __getattr__(name: str) -> Any:
    # Imported when first used: a client needs no Pinocchio, the extraction no network.
    if name in _HOME:
        import importlib

        from rtee.errors import check_system

        check_system()
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'rtee' has no attribute '{name}'")
