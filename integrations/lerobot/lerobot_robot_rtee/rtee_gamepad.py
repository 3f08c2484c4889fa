"""A gamepad as a teleoperator of LeRobot: its axes are intensities of grasping actions."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_robot_rtee.uncalibrated import Uncalibrated
from rtee.errors import ConfigError
from rtee.teleop.drive import assigned
from rtee.teleop.inputs import Gamepad, Input, open_gamepad


@TeleoperatorConfig.register_subclass("rtee_gamepad")
@dataclass(kw_only=True)
class RteeGamepadConfig(TeleoperatorConfig):
    """Which axis moves what.

    Attributes:
        actions: Actions with their elements, as the robot has them, each maybe with an axis before
            it: ``rt=PinchTight index thumb``.
        device: The gamepad, such as ``/dev/input/event5``; else the first one.
    """

    actions: list[str] = field(default_factory=list)
    device: str | None = None


class RteeGamepad(Uncalibrated, Teleoperator):
    """A gamepad; for a robot with the same ``actions``."""

    config_class = RteeGamepadConfig
    name = "rtee_gamepad"

    def __init__(self, config: RteeGamepadConfig) -> None:
        """Prepare; raises `ConfigError` for actions that the axes cannot move."""
        super().__init__(config)
        self.config = config
        if not config.actions:
            raise ConfigError("give the actions that the axes move: --teleop.actions='[\"…\"]'")
        self._pad: Input | None = None

    @cached_property
    def _axes(self) -> dict[str, str]:
        return assigned(self.config.actions, Gamepad.axes)

    @property
    def action_features(self) -> dict[str, Any]:
        """Intensities of the actions, 0 to 1."""
        return dict.fromkeys(self._axes.values(), float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the gamepad is open."""
        return self._pad is not None

    def connect(self, calibrate: bool = True) -> None:
        """Open the gamepad."""
        self._pad = open_gamepad(self.config.device)

    def get_action(self) -> dict[str, Any]:
        """Return how far each axis is moved; an axis not moved yet is released."""
        if self._pad is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        try:
            moved = self._pad.read()
        except OSError as error:
            raise ConfigError(f"the gamepad was disconnected: {error}") from None
        return {action: moved.get(axis, 0.0) for axis, action in self._axes.items()}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Leave the gamepad."""
        self._pad = None
