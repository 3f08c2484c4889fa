"""``hand.yaml``: the facts about a hand that its URDF and SRDF do not state."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

from msgspec import Meta, field

from rtee.hand.catalog import FILE_NAME
from rtee.hand.config_schema import (
    ActuatorDynamics,
    ActuatorLimits,
    AgentSettings,
    DeviceSection,
    FlangeSection,
    LogSection,
    LoopSection,
    MetricsSettings,
    Outside,
    ProfileSettings,
    RealtimeSettings,
    RemoteSettings,
    Ros2Settings,
    SafetySettings,
    ThermalSettings,
    TouchSection,
)
from rtee.hand.model import CLEARANCE
from rtee.hand.names import check_name
from rtee.hand.validation import Misfit, Section, checked, fitting
from rtee.hand.yamlfile import YamlDocument, read_yaml

DEFAULTS: Final = "defaults"
"""Key, in place of an actuator's name, for the values of all other actuators."""

MeasuredOpening = tuple[Annotated[float, Meta(ge=0, le=1)], Annotated[float, Meta(ge=0, le=2)]]
"""An intensity and the opening measured there [m]."""


class HandConfig(Section, frozen=True, kw_only=True):
    """A hand."""

    name: str
    """Its name: letters, digits, ``_``, ``-`` and ``.``; the same as its folder's."""
    title: str = ""
    """Its name for people."""
    urdf: str
    """Its URDF, relative to this file."""
    root: str | None = None
    """The hand's base link, if the URDF describes a whole robot; its frame is the hand's base
    frame. Unless given, the whole URDF is the hand."""
    outside: Outside = Outside.ABSENT
    """Treatment of the links that are not below ``root``: ``absent`` leaves them out, ``rigid``
    keeps them as obstacles, with all their joints at 0."""
    srdf: str | None = None
    """Its SRDF, relative to this file; without one the fingers are found from the tree."""
    package_dirs: list[str] = field(default_factory=list)
    """Folders in which ``package://`` addresses of meshes are looked up, relative to this file."""
    rest: dict[str, float] = field(default_factory=dict)
    """Rest positions by actuator [rad | m]; unless given, the SRDF's group_state ``rest``,
    ``open`` or ``home``, or 0 clamped into the limits."""
    ignore: list[str] = field(default_factory=list)
    """Actuators that take no part, such as those of a wrist: they stay fixed at ``rest``, move in
    no action and need no device."""
    limits: dict[str, ActuatorLimits] = field(default_factory=dict)
    """Limits that tighten or complete the URDF's, by actuator; ``defaults``: all others."""
    dynamics: dict[str, ActuatorDynamics] = field(default_factory=dict)
    """Dynamics by actuator: gains, inertia, friction and the way joints follow; ``defaults``
    applies to all others. Used by the simulation, and by planners that ask for the hand's
    description."""
    tip_friction: dict[str, Annotated[float, Meta(ge=0, le=10)]] = field(default_factory=dict)
    """Coefficient of friction of the fingertips' surfaces by finger; ``defaults`` applies to all
    others. Used by planners that ask for the hand's description. Unless given, the URDF's ``mu1``,
    if any."""
    touch: dict[str, TouchSection] = field(default_factory=dict)
    """Places of its touch sensors, by the names that their devices give them."""
    openings: dict[str, list[MeasuredOpening]] = field(default_factory=dict)
    """Openings measured on the real hand, by action and elements, such as ``PinchTight index
    thumb``: pairs of intensity and opening [m]."""
    clearance: Annotated[float, Meta(ge=0, le=0.1)] = CLEARANCE
    """Distance between links that must not touch, in clear poses and on the paths to them [m];
    links that are hardly farther apart at rest keep four fifths of their distance at rest."""
    payload: Annotated[float, Meta(gt=0)] | None = None
    """Largest mass that the hand may hold by friction according to its data sheet [kg]; trials
    report that heavier objects do not fit."""
    flange: FlangeSection | None = None
    """Mounting of the hand on an arm; with it, planned grasps and openings are also given for the
    arm's flange."""
    profile: ProfileSettings = ProfileSettings()
    """Motion of references between set-points."""
    loop: LoopSection = LoopSection()
    """The control loop."""
    realtime: RealtimeSettings = RealtimeSettings()
    """Requests to the operating system."""
    safety: SafetySettings = SafetySettings()
    """Behaviour of the hand when a program ends or a part fails."""
    thermal: ThermalSettings = ThermalSettings()
    """Temperatures of actuators."""
    log: LogSection = LogSection()
    """Recordings."""
    remote: RemoteSettings = RemoteSettings()
    """The hand on the network."""
    ros2: Ros2Settings = Ros2Settings()
    """The hand as a node of ROS 2."""
    metrics: MetricsSettings = MetricsSettings()
    """Metrics of the hand for Prometheus."""
    agent: AgentSettings = AgentSettings()
    """Permissions of a language model that uses the hand."""
    driver: Literal["kinematic", "devices"] = "kinematic"
    """Default of ``rtee run``: a kinematic simulation, or the ``devices``."""
    devices: dict[str, DeviceSection] = field(default_factory=dict)
    """The devices by name."""

    def __post_init__(self) -> None:
        """Check names and default limits, and that ``driver: devices`` has devices."""
        with fitting("name"):
            check_name(self.name, "hand")
        for what, section in (("touch sensor", "touch"), ("device", "devices")):
            for name in getattr(self, section):
                with fitting(section, name):
                    check_name(name, what)
        usual = self.limits.get(DEFAULTS, ActuatorLimits())
        for name in ("lower", "upper"):
            if getattr(usual, name) is not None:
                raise Misfit("should be given for each actuator", "limits", DEFAULTS, name)
        if self.driver == "devices" and not self.devices:
            raise ValueError("driver is 'devices', but 'devices' lists none")


def read_document(path: Path | str) -> tuple[HandConfig, YamlDocument]:
    """Read a hand.yaml, or the one in a folder; also return its document, which has the lines.

    Raises:
        ConfigError: if the file cannot be read or a value is wrong; with file, line and field.
    """
    file = Path(path)
    document = read_yaml(file / FILE_NAME if file.is_dir() else file, FILE_NAME)
    return checked(HandConfig, document), document
