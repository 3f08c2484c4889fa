"""A person's hand as a teleoperator of LeRobot: points of it are retargeted to any hand."""

import stat
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceNotConnectedError

import rtee
from lerobot_robot_rtee.uncalibrated import Uncalibrated
from rtee import monotonic
from rtee.errors import ConfigError, LogError, RteeError, needing_extra
from rtee.messages.features import ObservedQuantity, feature


@TeleoperatorConfig.register_subclass("rtee_landmarks")
@dataclass(kw_only=True)
class RteeLandmarksConfig(TeleoperatorConfig):
    """Whose points, and which hand follows them.

    Attributes:
        source: Points as ``rtee teleop --landmarks`` reads them: a file, which is played once, a
            named pipe or, as ``-``, the standard input.
        layout: Their order and unit: mediapipe, webxr, leap, manus, manus21 or mano.
        side: Which of the person's hands: right or left.
        hand: Name of the running hand; not needed if only one runs.
        connect: Its address, such as ``tcp/robot:7447``; else it is on this computer.
    """

    source: str = "-"
    layout: str = "mediapipe"
    side: str = "right"
    hand: str | None = None
    connect: str | None = None


class RteeLandmarks(Uncalibrated, Teleoperator):
    """Points of a person's hand; until one is seen, the hand stays where it is."""

    config_class = RteeLandmarksConfig
    name = "rtee_landmarks"

    def __init__(self, config: RteeLandmarksConfig) -> None:
        """Prepare; the hand is asked when it is first needed."""
        super().__init__(config)
        self.config = config
        self._newest: dict[str, float] = {}
        self._failed: RteeError | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @cached_property
    def _running(self) -> tuple[str, dict[str, float]]:
        """The hand's name, and its positions."""
        hand, endpoint = self.config.hand, self.config.connect
        with rtee.connect_blocking(hand, endpoint=endpoint, client="lerobot") as running:
            return running.name, running.state().positions

    @property
    def action_features(self) -> dict[str, Any]:
        """Targets of the actuators [rad | m]."""
        return {feature(ObservedQuantity.POSITION, name): float for name in self._running[1]}

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether points are read."""
        return self._thread is not None

    def connect(self, calibrate: bool = True) -> None:
        """Begin to read points.

        Raises:
            UserError: The points or the hand can't be used.
        """
        with needing_extra("retargeting", "retarget"):
            from rtee.retarget import Retargeter, TrackingError
            from rtee.retarget.frames import FrameReader, Patience, TrackerFrame, read_frames
            from rtee.retarget.layouts import layout_named, side_named
        config = self.config
        layout, side = layout_named(config.layout), side_named(config.side)
        self.__dict__.pop("_running", None)  # where it is now, not where it was
        name, positions = self._running
        retargeter = Retargeter.of(name, side=side)
        if set(retargeter.hand.actuator_names) != set(positions):
            raise ConfigError(
                f"the running {name} differs in its actuators from the hand of that name"
            )
        retargeter.begin(positions)
        self._newest, self._failed = positions, None
        path, ended = Path(config.source), threading.Event()
        live = config.source == "-" or (path.exists() and stat.S_ISFIFO(path.stat().st_mode))
        frames = [] if live else read_frames(path, layout, side)

        def coming() -> Iterator[TrackerFrame | None]:
            if live:
                reader, valid = FrameReader(layout, side, config.source), Patience(LogError)
                with sys.stdin if config.source == "-" else path.open() as file:
                    for line in file:
                        with valid:
                            yield reader.read(line)
            for frame in frames:
                stamp = begin + frame.stamp - frames[0].stamp
                ended.wait(max(0.0, stamp - monotonic.now()))
                yield replace(frame, stamp=stamp)

        def follow() -> None:
            patience = Patience(TrackingError)
            try:
                for frame in coming():
                    if ended.is_set():
                        return
                    if frame is not None:
                        with patience:
                            self._newest = retargeter.step(frame.points, frame.stamp)
            except RteeError as error:
                self._failed = error

        begin, self._ended = monotonic.now(), ended
        # A daemon: nothing ends the wait for a line.
        self._thread = threading.Thread(target=follow, name="landmarks", daemon=True)
        self._thread.start()

    def get_action(self) -> dict[str, Any]:
        """Return the answer to the newest points; raises the error of points without sense."""
        if self._thread is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        if self._failed is not None:
            raise self._failed
        return {
            feature(ObservedQuantity.POSITION, name): value for name, value in self._newest.items()
        }

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Read no more points."""
        self._ended.set()
        self._thread = None
