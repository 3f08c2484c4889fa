"""A running hand as a robot of LeRobot: a client of its network, which moves it by a stream."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from lerobot.cameras import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import rtee
from rtee.errors import ConfigError
from rtee.loop.measured import TIP_FORCE, tip_forces
from rtee.messages.features import USUAL, Quantity, feature, observed, quantities
from rtee.remote.blocking import BlockingHand, BlockingStream
from rtee.remote.hand_info import HandInfo


@RobotConfig.register_subclass("rtee_hand")
@dataclass(kw_only=True)
class RteeHandConfig(RobotConfig):
    """Which hand, and what of it.

    Attributes:
        hand: Its name; not needed if only one hand runs.
        connect: Its address, such as ``tcp/robot:7447``; else it is on this computer.
        actions: Grasping actions with their elements, whose intensities are the action
            (``PinchTight index thumb``); none: the targets of the actuators are.
        observe: What is observed, all of which must be known: position, joint, effort, opening,
            force, touch, taxel; none: all that the hand knows but taxels.
        effort: Effort limits as a share of the hand's own, above 0 up to 1.
        rate: Most actions per second [Hz].
        deadline: Time without an action after which the hand brakes and holds [s].
        cameras: Cameras of LeRobot.
    """

    hand: str | None = None
    connect: str | None = None
    actions: list[str] = field(default_factory=list)
    observe: list[str] = field(default_factory=list)
    effort: float = 1.0
    rate: float = 60.0
    deadline: float = 0.2
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class RteeHand(Robot):
    """A running hand. `connect` takes the right to move it, `disconnect` and `stop` give it back.

    What it observes and takes is asked of the hand itself, before `connect`, too.
    """

    config_class = RteeHandConfig
    name = "rtee_hand"

    def __init__(self, config: RteeHandConfig) -> None:
        """Prepare; the hand is asked when it is first needed."""
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self._wanted = quantities(config.observe) or USUAL
        self._opened = contextlib.ExitStack()
        self._link: BlockingHand | None = None
        self._stream: BlockingStream | None = None
        self._last: dict[str, float] = {}

    def _hand(self) -> BlockingHand:
        """Return the connection to the hand, which moves nothing by itself."""
        if self._link is None:
            self._link = self._opened.enter_context(
                rtee.connect_blocking(
                    self.config.hand, endpoint=self.config.connect, client="lerobot"
                )
            )
        return self._link

    @cached_property
    def _info(self) -> HandInfo:
        return self._hand().info()

    @cached_property
    def _limits(self) -> dict[str, tuple[float, float]]:
        if self.config.actions:
            return dict.fromkeys(self.config.actions, (0.0, 1.0))
        return {
            feature(Quantity.POSITION, each.name): (each.lower, each.upper)
            for each in self._info.actuators
        }

    @cached_property
    def _targets(self) -> dict[str, str]:
        """Names of the stream's targets by feature."""
        names = self.config.actions or [each.name for each in self._info.actuators]
        return dict(zip(self._limits, names, strict=True))

    @cached_property
    def _observed(self) -> tuple[str, ...]:
        seen = {quantity: self._observe((quantity,)) for quantity in self._wanted}
        known = [n for each in seen.values() for n, v in each.items() if math.isfinite(v)]
        for quantity, each in seen.items():
            if self.config.observe and not (each and each.keys() <= set(known)):
                raise ConfigError(
                    f"{self._info.name} does not know its {quantity} now; observe something else, "
                    "or, for an opening, let it do an action first (rtee open)"
                )
        return tuple(known)

    def _observe(self, wanted: Sequence[Quantity]) -> dict[str, float]:
        hand = self._hand()
        state = hand.state()
        forces = [v for name, v in state.channels.items() if name.endswith(f"/{TIP_FORCE}")]
        touch = hand.touch_state().values() if self._touches else ()
        fingers = [finger.name for finger in self._info.fingers]
        return observed(state, touch, tip_forces(forces), fingers, wanted)

    @cached_property
    def _touches(self) -> bool:
        return bool(self._hand().touch_state())

    @property
    def observation_features(self) -> dict[str, Any]:
        """The numbers known of the hand, and the shapes of images."""
        shapes = {name: (c.height, c.width, 3) for name, c in self.config.cameras.items()}
        return dict.fromkeys(self._observed, float) | shapes

    @property
    def action_features(self) -> dict[str, Any]:
        """Targets of the actuators [rad | m], or intensities of actions, 0 to 1."""
        return dict.fromkeys(self._limits, float)

    @property
    def is_connected(self) -> bool:
        """Whether the hand can be moved."""
        return self._stream is not None

    @property
    def is_calibrated(self) -> bool:
        """Always: a hand is calibrated where it runs."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing: hand.yaml configures the hand."""

    def connect(self, calibrate: bool = True) -> None:
        """Wait until the hand is ready, and take the right to move it; nothing moves yet."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        try:
            hand = self._hand()
            hand.ready()
            for camera in self.cameras.values():
                camera.connect()
                self._opened.callback(camera.disconnect)
            config = self.config
            stream = hand.stream(config.rate, config.deadline, config.effort)
            self._stream = self._opened.enter_context(stream)
        except BaseException:
            self.disconnect()
            raise

    def get_observation(self) -> dict[str, Any]:
        """Return what is known now; a number that is not for a moment stays as it was."""
        self._check()
        numbers = self._observe(self._wanted)
        self._last |= {name: value for name, value in numbers.items() if math.isfinite(value)}
        images = {name: camera.read_latest() for name, camera in self.cameras.items()}
        return {name: self._last[name] for name in self._observed} | images

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send targets, to which the hand moves smoothly, and return them as they were sent.

        Targets beyond the limits are sent as the limits. The hand's recording has what its motors
        were told at each tick.

        Raises:
            ConfigError: The action is another hand's, or has a number that is not finite.
            RemoteError: The hand refuses it, for example since something else moves it by now.
        """
        stream = self._check()
        if action.keys() != self._limits.keys():
            raise ConfigError(
                f"the action is not one of {self._info.name}: it has {', '.join(sorted(action))}; "
                f"the hand takes {', '.join(self._limits)}"
            )
        sent = {}
        for name, (lower, upper) in self._limits.items():
            value = float(action[name])
            if not math.isfinite(value):
                raise ConfigError(f"the action has {value} for {name}: nothing of it is sent")
            sent[name] = min(max(value, lower), upper)
        stream.send({self._targets[name]: value for name, value in sent.items()})
        return sent

    def stop(self) -> None:
        """Stop the hand at once, and give back the right to move it."""
        try:
            self._hand().stop()
        finally:
            self.disconnect()

    def disconnect(self) -> None:
        """Let the hand hold where it is, and give back the right to move it."""
        self._stream = self._link = None
        self._opened.close()

    def _check(self) -> BlockingStream:
        if self._stream is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        return self._stream
