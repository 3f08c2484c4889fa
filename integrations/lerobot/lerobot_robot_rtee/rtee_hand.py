"""A running hand as a robot of LeRobot: a client of its network, which moves it by a stream."""

import atexit
import contextlib
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import Any

from lerobot.cameras import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import rtee
from lerobot_robot_rtee.uncalibrated import Uncalibrated
from rtee.errors import ConfigError, RequestRejected
from rtee.loop.measured import TIP_FORCE, tip_forces
from rtee.messages.features import USUAL, ObservedQuantity, feature, observed, quantities
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


class RteeHand(Uncalibrated, Robot):
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
        self._moving: tuple[BlockingHand, BlockingStream] | None = None
        self._last: dict[str, float] = {}

    def _link(self) -> BlockingHand:
        """Return a new connection to the hand, which moves nothing by itself."""
        hand, endpoint = self.config.hand, self.config.connect
        return rtee.connect_blocking(hand, endpoint=endpoint, client="lerobot")

    @cached_property
    def _info(self) -> HandInfo:
        with self._link() as hand:
            return hand.info()

    @cached_property
    def _known(self) -> dict[ObservedQuantity, tuple[str, ...]]:
        """Names of the numbers that the hand knows, by quantity."""
        with self._link() as hand:
            seen = {each: self._observe(hand, (each,)) for each in self._wanted}
        known = {q: tuple(n for n, v in s.items() if math.isfinite(v)) for q, s in seen.items()}
        for quantity, names in known.items():
            if self.config.observe and not (names and len(names) == len(seen[quantity])):
                raise ConfigError(
                    f"{self._info.name} does not know its {quantity} now; observe something else, "
                    "or, for an opening, let it do an action first (rtee open)"
                )
        return {quantity: names for quantity, names in known.items() if names}

    @cached_property
    def _limits(self) -> dict[str, tuple[float, float]]:
        if self.config.actions:
            return dict.fromkeys(self.config.actions, (0.0, 1.0))
        return {
            feature(ObservedQuantity.POSITION, each.name): (each.lower, each.upper)
            for each in self._info.actuators
        }

    @cached_property
    def _targets(self) -> dict[str, str]:
        """Names of the stream's targets by feature."""
        names = self.config.actions or [each.name for each in self._info.actuators]
        return dict(zip(self._limits, names, strict=True))

    def _observe(
        self, hand: BlockingHand, wanted: Collection[ObservedQuantity]
    ) -> dict[str, float]:
        state = hand.state()
        forces = [v for name, v in state.channels.items() if name.endswith(f"/{TIP_FORCE}")]
        # Another request: only where there is something to feel.
        feels = not {ObservedQuantity.TOUCH, ObservedQuantity.TAXEL}.isdisjoint(wanted)
        touch = hand.touch_state().values() if feels else ()
        fingers = [finger.name for finger in self._info.fingers]
        return observed(state, touch, tip_forces(forces), fingers, wanted)

    @property
    def observation_features(self) -> dict[str, Any]:
        """The numbers known of the hand, and the shapes of images."""
        shapes = {name: (c.height, c.width, 3) for name, c in self.config.cameras.items()}
        return dict.fromkeys(chain(*self._known.values()), float) | shapes

    @property
    def action_features(self) -> dict[str, Any]:
        """Targets of the actuators [rad | m], or intensities of actions, 0 to 1."""
        return dict.fromkeys(self._limits, float)

    @property
    def is_connected(self) -> bool:
        """Whether the hand can be moved."""
        return self._moving is not None

    def connect(self, calibrate: bool = True) -> None:
        """Wait until the hand is ready, and take the right to move it; nothing moves yet."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        try:
            hand = self._opened.enter_context(self._link())
            hand.ready()
            for camera in self.cameras.values():
                camera.connect()
                self._opened.callback(camera.disconnect)
            config = self.config
            stream = hand.stream(config.rate, deadline=config.deadline, effort=config.effort)
            self._moving = hand, self._opened.enter_context(stream)
            # A program that ends all the same must not leave the hand without a word.
            atexit.register(self.disconnect)
        except BaseException:
            self.disconnect()
            raise

    def get_observation(self) -> dict[str, Any]:
        """Return what is known now; a number that is not for a moment stays as it was."""
        hand, _ = self._check()
        numbers = self._observe(hand, self._known)
        self._last |= {name: value for name, value in numbers.items() if math.isfinite(value)}
        images = {name: camera.read_latest() for name, camera in self.cameras.items()}
        return {name: self._last[name] for name in chain(*self._known.values())} | images

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send targets, to which the hand moves smoothly, and return them as they were sent.

        Targets beyond the limits are sent as the limits. The hand's recording has what its motors
        were told at each tick.

        Raises:
            ConfigError: The action is another hand's, or has a number that is not finite.
            RemoteError: The hand refuses it, for example since something else moves it by now.
        """
        _, stream = self._check()
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
        hand, _ = self._check()
        try:
            hand.stop()
        finally:
            # It overtakes actions, which are refused then.
            with contextlib.suppress(RequestRejected):
                self.disconnect()

    def disconnect(self) -> None:
        """Let the hand hold where it is, and give back the right to move it."""
        self._moving = None
        atexit.unregister(self.disconnect)
        self._opened.close()

    def _check(self) -> tuple[BlockingHand, BlockingStream]:
        if self._moving is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        return self._moving
