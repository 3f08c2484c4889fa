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
"""The name, among those of actuators, of what holds for all others."""

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
    """The link below which the hand is, where the URDF describes a whole robot; its frame is the
    hand's. Unless given, all of the URDF is the hand."""
    outside: Outside = Outside.ABSENT
    """What becomes of what is not below ``root``: ``absent``, or ``rigid``: it stays as an
    obstacle, with all its joints at 0."""
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
    """Limits that tighten or complete the URDF's, by actuator, ``defaults``: of all others."""
    dynamics: dict[str, ActuatorDynamics] = field(default_factory=dict)
    """Dynamics by actuator, ``defaults``: what holds for all where they say nothing else; gains,
    inertia, friction, how joints follow them; for the simulation, and for planners that ask for the
    hand's description."""
    tip_friction: dict[str, Annotated[float, Meta(ge=0, le=10)]] = field(default_factory=dict)
    """Coefficient of friction of the fingertips' surfaces by finger, ``defaults``: of all others;
    for planners that ask for the hand's description. Unless given, the URDF's ``mu1``, if any."""
    touch: dict[str, TouchSection] = field(default_factory=dict)
    """Where its touch sensors are, by the names that their devices give them."""
    openings: dict[str, list[MeasuredOpening]] = field(default_factory=dict)
    """Openings measured on the real hand, by action and elements, such as ``PinchTight index
    thumb``: pairs of intensity and opening [m]."""
    clearance: Annotated[float, Meta(ge=0, le=0.1)] = CLEARANCE
    """Distance that clear poses and the ways to them keep from all links that they are not to touch
    [m]; links that have hardly more at rest keep four fifths of what they have there."""
    payload: Annotated[float, Meta(gt=0)] | None = None
    """Largest mass that its data sheet lets it hold by friction [kg]; trials of heavier objects say
    that they do not fit."""
    flange: FlangeSection | None = None
    """Where the hand sits on an arm; with it, planned grasps and openings are also given for the
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
    """What a language model may do with the hand."""
    driver: Literal["kinematic", "devices"] = "kinematic"
    """What ``rtee run`` drives by default: a kinematic stand-in, or the ``devices``."""
    devices: dict[str, DeviceSection] = field(default_factory=dict)
    """The devices by name."""

    def __post_init__(self) -> None:
        """Check names, default limits, and that there are devices where they are to be driven."""
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
            raise ValueError("driver is 'devices' but no devices are given")


def read_document(path: Path | str) -> tuple[HandConfig, YamlDocument]:
    """Read a hand.yaml, or the one in a folder; also return its document, which has the lines.

    Raises:
        ConfigError: If the file cannot be read or a value is wrong; with file, line and field.
    """
    file = Path(path)
    document = read_yaml(file / FILE_NAME if file.is_dir() else file, FILE_NAME)
    return checked(HandConfig, document), document
