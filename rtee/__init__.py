"""rtee: command any robotic hand or gripper by grasping actions.

Example:
    async with rtee.connect("schunk_svh") as hand:
        result = await hand.do("pinch_tight", "index", "thumb", intensity=0.6)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary as ActionLibrary
    from rtee.actions.library import load_actions as load_actions
    from rtee.actions.types import Action as Action
    from rtee.actions.types import ActionReference as ActionReference
    from rtee.errors import ConfigError as ConfigError
    from rtee.errors import GoalRejected as GoalRejected
    from rtee.errors import LeaseHeld as LeaseHeld
    from rtee.errors import NoHand as NoHand
    from rtee.errors import NotReady as NotReady
    from rtee.errors import RemoteError as RemoteError
    from rtee.errors import RequestRejected as RequestRejected
    from rtee.errors import RteeError as RteeError
    from rtee.errors import UserError as UserError
    from rtee.hand.load import load_hand as load_hand
    from rtee.hand.model import Hand as Hand
    from rtee.messages.state import State as State
    from rtee.planning.plan import grasp_plan as grasp_plan
    from rtee.planning.result import Ranking as Ranking
    from rtee.remote.blocking import BlockingGoal as BlockingGoal
    from rtee.remote.blocking import BlockingHand as BlockingHand
    from rtee.remote.blocking import BlockingStream as BlockingStream
    from rtee.remote.blocking import connect_blocking as connect_blocking
    from rtee.remote.client import RemoteHand as RemoteHand
    from rtee.remote.client import connect as connect
    from rtee.remote.directory import hands_running as hands_running
    from rtee.remote.goal import RunningGoal as RunningGoal
    from rtee.remote.goal_values import action_goal as action_goal
    from rtee.remote.goal_values import grasp_goal as grasp_goal
    from rtee.remote.goal_values import touch_goal as touch_goal
    from rtee.remote.hand_info import HandInfo as HandInfo
    from rtee.remote.monitoring import HandStatus as HandStatus
    from rtee.remote.stream import Stream as Stream
    from rtee.testing.simulated import SimulatedHand as SimulatedHand
    from rtee.testing.simulated import simulated as simulated
    from rtee.trials.batch import run_trials as run_trials
    from rtee.trials.result import Trial as Trial
    from rtee.trials.result import TrialResult as TrialResult
    from rtee.types import Around as Around
    from rtee.types import Event as Event
    from rtee.types import EventKind as EventKind
    from rtee.types import Feedback as Feedback
    from rtee.types import Fingers as Fingers
    from rtee.types import FirstContact as FirstContact
    from rtee.types import Force as Force
    from rtee.types import Goal as Goal
    from rtee.types import Intensity as Intensity
    from rtee.types import Named as Named
    from rtee.types import OnContact as OnContact
    from rtee.types import Opening as Opening
    from rtee.types import Outcome as Outcome
    from rtee.types import Result as Result
    from rtee.types import Shortfall as Shortfall
    from rtee.types import Stage as Stage
    from rtee.types import TipSpeed as TipSpeed

_NAMES = {
    "rtee.actions.library": "ActionLibrary load_actions",
    "rtee.actions.types": "Action ActionReference",
    "rtee.errors": "ConfigError GoalRejected LeaseHeld NoHand NotReady RemoteError RequestRejected"
    " RteeError UserError",
    "rtee.hand.load": "load_hand",
    "rtee.hand.model": "Hand",
    "rtee.messages.state": "State",
    "rtee.planning.plan": "grasp_plan",
    "rtee.planning.result": "Ranking",
    "rtee.remote.blocking": "BlockingGoal BlockingHand BlockingStream connect_blocking",
    "rtee.remote.client": "RemoteHand connect",
    "rtee.remote.directory": "hands_running",
    "rtee.remote.goal_values": "action_goal grasp_goal touch_goal",
    "rtee.remote.hand_info": "HandInfo",
    "rtee.remote.monitoring": "HandStatus",
    "rtee.remote.goal": "RunningGoal",
    "rtee.remote.stream": "Stream",
    "rtee.testing.simulated": "SimulatedHand simulated",
    "rtee.trials.batch": "run_trials",
    "rtee.trials.result": "Trial TrialResult",
    "rtee.types": "Around Event EventKind Feedback Fingers FirstContact Force Goal Intensity Named"
    " OnContact Opening Outcome Result Shortfall Stage TipSpeed",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}
_EXTRAS = {"grasp_plan": "extract", "run_trials": "sim"}

__all__ = sorted(_HOME)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def __getattr__(name: str) -> Any:
    # Imported on first use: a client does not need Pinocchio, nor the extraction the network.
    import importlib

    if name == "__version__":
        from importlib.metadata import version

        return version("rtee")
    if name not in _HOME:
        raise AttributeError(f"module 'rtee' has no attribute '{name}'")
    from rtee.errors import check_system, needing_extra

    check_system()
    with needing_extra(f"rtee.{name}", _EXTRAS.get(name, "all")):
        return getattr(importlib.import_module(_HOME[name]), name)
