"""Load a hand: from a URDF with or without an SRDF, or from its folder in ``config/``."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from msgspec import structs

from rtee.errors import ConfigError, ModelError, UnknownActuator, UserError, suggestion
from rtee.hand.catalog import FILE_NAME, find_hand
from rtee.hand.chains import check_srdf, joints_of_hand
from rtee.hand.config import DEFAULTS, HandConfig, read_document
from rtee.hand.config_schema import ActuatorDynamics, Following, Outside, TouchSection
from rtee.hand.discovery import find_branches, make_fingers
from rtee.hand.limits import (
    Overrides,
    actuator_spec,
    images_outside,
    rest_note,
    rest_state,
    soft_notes,
    standing_position,
    velocity_note,
)
from rtee.hand.linkages import Mover
from rtee.hand.model import Finger, Hand, Joint, JointRole
from rtee.hand.names import check_name, safe_name
from rtee.hand.srdf import Srdf, read_srdf
from rtee.hand.subtree import Subtree, srdf_within
from rtee.hand.transmission import Transmission, check_mimics, make_transmission
from rtee.hand.urdf import LARGE, Urdf, UrdfJoint
from rtee.hand.urdfread import Edit, read_urdf
from rtee.hand.whole_robot import arm_joints
from rtee.hand.yamlfile import YamlDocument
from rtee.types import ActuatorSpec, JointKind, readonly

_HEAVY = 5.0
"""Mass of a finger's link that is likely meant in grams [kg]: whole hands weigh less."""

_MODELS = {".urdf": "--urdf", ".xacro": "--urdf", ".xml": "--mjcf"}
"""Files given in place of a hand, and the option that makes a hand of each."""


def load_model(
    urdf: Path | str,
    srdf: Path | str | None = None,
    *,
    name: str | None = None,
    package_dirs: Sequence[Path | str] = (),
    rest: Mapping[str, float] | None = None,
    ignore: Sequence[str] = (),
    passive: Collection[str] = (),
    actuators: Collection[str] | None = None,
    edits: Sequence[Edit] = (),
) -> Hand:
    """Load a hand from its URDF.

    Args:
        urdf: The URDF.
        srdf: The SRDF that names the fingers; without one they are found from the tree.
        name: The hand's name; the robot's in the URDF unless given.
        package_dirs: Folders in which to look up mesh packages.
        rest: Rest positions by actuator [rad | m]; they override the SRDF's and 0.
        ignore: Actuators that stay at rest and take no part.
        passive: Joints without a motor, in addition to the SRDF's.
        actuators: The actuators, if they are known; other joints that could be one stay fixed.
        edits: Changes of the URDF, such as which part of a whole robot is the hand.

    Raises:
        ModelError: if a file cannot be read or does not describe a hand.
        ConfigError: if the name is not allowed.
    """
    model, semantics = read_both(urdf, srdf, edits)
    if actuators is not None:
        settled = {*actuators, *passive, *(semantics.passive if semantics else ())}
        free = (j.name for j in model.joints.values() if j.moving and j.mimic is None)
        # A recording lists its actuators: other moving joints were ignored when it was made.
        ignore = [*ignore, *(name for name in free if name not in settled)]
    overrides = Overrides(
        HandConfig(name="hand", urdf="", rest=dict(rest or {}), ignore=list(ignore)),
        name=name,
        package_dirs=tuple(Path(p) for p in package_dirs),
        passive=frozenset(passive),
    )
    return build_hand(model, semantics, overrides)


def read_both(
    urdf: Path | str, srdf: Path | str | None, edits: Sequence[Edit]
) -> tuple[Urdf, Srdf | None]:
    """Read a URDF and its SRDF; of a whole robot, only the hand's part."""
    model = read_urdf(urdf, edits)
    semantics = None if srdf is None else read_srdf(srdf)
    if semantics is not None and any(isinstance(edit, Subtree) for edit in edits):
        semantics = srdf_within(semantics, model)
    return model, semantics


def load_hand(name_or_path: str | Path, *, config_dirs: Sequence[Path | str] = ()) -> Hand:
    """Load a configured hand.

    Args:
        name_or_path: Its name, or the path of its folder or hand.yaml.
        config_dirs: Folders in which to look up the name, before the usual ones.

    Raises:
        ConfigError: if there is no such hand, or its hand.yaml is wrong.
        ModelError: if its URDF or SRDF cannot be read or does not describe a hand.
    """
    return load_configured(name_or_path, config_dirs=config_dirs)[0]


def load_configured(
    name_or_path: str | Path, *, config_dirs: Sequence[Path | str] = ()
) -> tuple[Hand, HandConfig]:
    """Load a configured hand together with its configuration; see `load_hand`."""
    return load_documented(name_or_path, config_dirs=config_dirs)[:2]


def load_documented(
    name_or_path: str | Path, *, config_dirs: Sequence[Path | str] = ()
) -> tuple[Hand, HandConfig, YamlDocument]:
    """Load a configured hand with its configuration and the document of its hand.yaml."""
    folder, file = hand_folder(name_or_path, config_dirs=config_dirs)
    config, document = read_document(file)
    # Found by its folder's name, so recordings and network keys must use the same one.
    if not is_path(name_or_path) and config.name != folder.name:
        raise document.error(
            ("name",), f"'{config.name}' should be the name of its folder, '{folder.name}'"
        )
    urdf = _beside(folder, config.urdf, "urdf", document)
    srdf = None if config.srdf is None else _beside(folder, config.srdf, "srdf", document)
    overrides = Overrides(
        config,
        name=config.name,
        package_dirs=tuple(folder / package for package in config.package_dirs),
        error=document.error,
    )
    made = build_hand(*read_both(urdf, srdf, _subtree(config, document)), overrides)
    hand = replace(made, folder=folder)
    _check_devices(hand, config, document)
    joint = config.ros2.gripper_joint
    if joint and joint not in hand.actuator_names:
        hint = suggestion(joint, hand.actuator_names)
        raise document.error(("ros2", "gripper_joint"), f"unknown actuator '{joint}'; {hint}")
    return hand, config, document


def _subtree(config: HandConfig, document: YamlDocument) -> list[Edit]:
    if config.root is None and config.outside is not Outside.ABSENT:
        raise document.error(
            ("outside",), "needs 'root:', because it applies to the links outside the root"
        )
    return [] if config.root is None else [Subtree(config.root, config.outside)]


def hand_folder(
    hand: Hand | str | Path, *, config_dirs: Sequence[Path | str] = ()
) -> tuple[Path, Path]:
    """Return the folder and the hand.yaml of a hand, or of one given by name or path.

    Raises:
        ConfigError: if there is no such hand, or it was made without a folder.
    """
    if isinstance(hand, Hand):
        if hand.folder is None:
            raise ConfigError(f"the hand '{hand.name}' has no folder; load it with rtee.load_hand")
        return hand.folder, hand.folder / FILE_NAME
    name_or_path = hand
    if not is_path(name_or_path):
        folder = find_hand(str(name_or_path), config_dirs)
        return folder, folder / FILE_NAME
    path = Path(name_or_path)
    option = _MODELS.get(path.suffix)
    # Unlike Path.is_dir, os.path.isdir accepts overlong names and folders that may not be entered.
    if option is not None and not os.path.isdir(path):
        text = f"is a model, not a hand; `rtee new NAME {option} {path}` makes a hand of it"
        raise ConfigError(text, path=path)
    file = path / FILE_NAME if os.path.isdir(path) else path
    if not os.path.isfile(file):
        raise ConfigError(f"is not a hand's folder: it has no {FILE_NAME}", path=path)
    return file.parent, file


def is_path(name_or_path: str | Path) -> bool:
    """Return whether the text in place of a hand is a path, not a name.

    Raises `ConfigError` for anything else.
    """
    if isinstance(name_or_path, Path):
        return True
    if not isinstance(name_or_path, str):
        raise ConfigError(
            f"a hand is given by its name or the path of its folder, not {name_or_path!r:.100}"
        )
    return "/" in name_or_path or name_or_path.endswith((".", ".yaml", ".yml", *_MODELS))


def _beside(folder: Path, name: str, key: str, document: YamlDocument) -> Path:
    """Return a file named in hand.yaml."""
    try:
        if (folder / name).is_file():
            return folder / name
    # A name may be too long for the file system, or hold a null character.
    except (OSError, ValueError):
        pass
    raise document.error((key,), f"the file '{name[:200]}' does not exist beside {FILE_NAME}")


def _check_devices(hand: Hand, config: HandConfig, document: YamlDocument) -> None:
    """Refuse unknown actuators and actuators that two devices drive."""
    owner: dict[str, str] = {}
    for name, device in config.devices.items():
        chosen = hand.actuator_names if device.actuators == "all" else device.actuators
        for i, actuator in enumerate(chosen):
            place = ("devices", name, "actuators", *(() if device.actuators == "all" else (i,)))
            if actuator in config.ignore:
                raise document.error(
                    place, f"actuator '{actuator}' is ignored; no device drives it"
                )
            if actuator not in hand.actuator_names:
                hint = suggestion(actuator, hand.actuator_names)
                raise document.error(place, f"unknown actuator '{actuator}'; {hint}")
            if actuator in owner:
                raise document.error(
                    place, f"actuator '{actuator}' is already driven by '{owner[actuator]}'"
                )
            owner[actuator] = name
    # Without devices the hand runs kinematically, and no actuator needs one.
    missing = [a for a in hand.actuator_names if config.devices and a not in owner]
    if missing:
        raise document.error(("devices",), f"no device drives the actuator '{missing[0]}'")


def build_hand(urdf: Urdf, srdf: Srdf | None, overrides: Overrides) -> Hand:
    """Build a hand from its description files and overrides.

    Raises:
        ModelError: if the files do not describe a hand.
        ConfigError: if a name or a configured value is not allowed.
    """
    config = overrides.config
    # First, since what follows looks up the names in the SRDF unchecked.
    notes = [*urdf.unread, *(check_srdf(srdf, urdf) if srdf else [])]
    unknown = next((n for n in overrides.passive if n not in urdf.joints), None)
    if unknown is not None:
        raise ModelError(
            f"unknown joint '{unknown}' under 'passive'; {suggestion(unknown, urdf.joints)}"
        )
    # A passive joint may be fixed (`check_srdf` notes it); such a joint has no role.
    passive = {
        n for n in (*(srdf.passive if srdf else ()), *overrides.passive) if urdf.joints[n].moving
    }
    roles = {joint.name: _role(joint, passive) for joint in urdf.joints.values() if joint.moving}
    _check_ignored(roles, overrides, urdf)
    # After the check: only actuators can be ignored.
    roles |= dict.fromkeys(overrides.config.ignore, JointRole.IGNORED)
    apart, why = _outside(urdf, srdf, roles)
    roles |= dict.fromkeys(apart, JointRole.IGNORED)
    notes += why
    joints = tuple(_joint(urdf.joints[name], role) for name, role in roles.items())
    driven = [joint.name for joint in joints if joint.role is JointRole.ACTUATOR]
    if not driven:
        check_mimics(urdf)  # the likelier mistake
        raise urdf.error(
            "no joint is an actuator: every moving joint is mimic, passive or ignored, or there is "
            "none"
        )
    _check_actuators(driven, apart, overrides, urdf)
    state_name, state = rest_state(srdf)
    notes += rest_note(state_name, state, driven, overrides)
    moved = [urdf.joints[name] for name in driven]
    notes += soft_notes(moved, urdf, overrides) + velocity_note(moved, urdf, overrides)
    specs = []
    for name in driven:
        spec, assumed = actuator_spec(urdf.joints[name], urdf, state, overrides)
        specs.append(spec)
        notes += assumed
    # Passive joints need a position, too: the transmission maps to all moving joints.
    standing = {
        joint.name: standing_position(urdf.joints[joint.name], urdf, state, overrides)
        for joint in joints
        if joint.role in (JointRole.PASSIVE, JointRole.IGNORED)
    }
    transmission = make_transmission(urdf, driven, standing)
    notes += images_outside(joints, specs, transmission)
    notes += _distance(urdf, [j.name for j in joints if j.role is not JointRole.IGNORED])
    # Fingers are known by what moves them, so the transmission comes first.
    fingers, found = make_fingers(urdf, srdf, _movers(joints, specs, transmission))
    found += _heavy(fingers, urdf)
    return Hand(
        name=check_name(overrides.name or safe_name(urdf.name), "hand"),
        base=urdf.root,
        joints=joints,
        actuators=tuple(
            # A finger without a tip cannot touch anything, so no action uses it.
            replace(s, fingers=tuple(f.name for f in fingers if f.tip and s.name in f.actuators))
            for s in specs
        ),
        fingers=fingers,
        transmission=transmission,
        rest=readonly([spec.rest for spec in specs]),
        urdf=urdf,
        disabled_collisions=tuple(
            (pair.link1, pair.link2, pair.reason)
            for pair in (srdf.disabled if srdf else ())
            # Others are noted; users of the pairs may rely on their links.
            if pair.link1 in urdf.links and pair.link2 in urdf.links
        ),
        notes=tuple(notes + found),
        package_dirs=overrides.package_dirs,
        description=config.title,
        clearance=config.clearance,
        payload=math.inf if config.payload is None else config.payload,
        openings={name: tuple(pairs) for name, pairs in config.openings.items()},
        dynamics=_make_dynamics(overrides, driven, urdf, transmission),
        tip_friction=_tip_friction(fingers, overrides, urdf),
        touch=_touch(overrides, urdf),
        flange=config.flange,
    )


def _outside(
    urdf: Urdf, srdf: Srdf | None, roles: Mapping[str, JointRole]
) -> tuple[list[str], list[str]]:
    """Return the actuators that are not the hand's, and a note about them."""
    free = [name for name, role in roles.items() if role is JointRole.ACTUATOR]
    hand = joints_of_hand(srdf, urdf) if srdf else None
    if hand is not None:
        used = {urdf.master(name) for name in hand}
        apart = [name for name in free if name not in used]
        what = "outside the SRDF's groups of the hand"
    else:
        movers = {
            name: Mover(master, 1.0) for name in roles if (master := urdf.master(name)) in free
        }
        apart = list(arm_joints(find_branches(urdf, movers), urdf, movers))
        what = "those of an arm"
    if not apart or len(apart) == len(free):
        return [], []
    names = ", ".join(f"'{name}'" for name in apart)
    are = "is" if len(apart) == 1 else "are"
    them = "it takes no part and stays" if len(apart) == 1 else "they take no part and stay"
    return apart, [f"{names} {are} {what}: {them} at rest"]


def _distance(urdf: Urdf, moving: Iterable[str]) -> list[str]:
    """Return a note on the joint farthest from its parent link, if it is too far for a hand."""
    far = {name: math.hypot(*urdf.joints[name].xyz) for name in moving}
    name = max(far, key=far.__getitem__)
    if far[name] <= LARGE:
        return []
    return [
        f"joint '{name}' is {far[name]:.3g} m from the frame of its parent link; are positions "
        "in millimetres? URDFs have metres"
    ]


def _heavy(fingers: Sequence[Finger], urdf: Urdf) -> list[str]:
    """Return a note on links of fingers whose masses are likely not in kilograms."""
    links = dict.fromkeys(link for finger in fingers for link in (*finger.links[1:], *finger.bars))
    heavy = [link for link in links if urdf.links[link].mass > _HEAVY]
    if not heavy:
        return []
    more = f" ({len(heavy)} links of fingers weigh more than {_HEAVY:g} kg)" * (len(heavy) > 1)
    return [
        f"link '{heavy[0]}' weighs {urdf.links[heavy[0]].mass:g} kg{more}; is its mass in grams? "
        "URDFs have kilograms, and simulation takes them as they are"
    ]


def _movers(
    joints: Sequence[Joint], specs: Sequence[ActuatorSpec], transmission: Transmission
) -> dict[str, Mover]:
    """Return the actuators that move each joint, at mid-range; joints without any are missing."""
    middle = [0.5 * (s.lower + s.upper) if math.isfinite(s.upper - s.lower) else 0.0 for s in specs]
    slopes = transmission.jacobian(np.array(middle))
    moves = [transmission.moves(i) for i in range(len(joints))]
    return {
        joint.name: Mover(specs[index].name, float(slopes[row, index]))
        for row, (joint, index) in enumerate(zip(joints, moves, strict=True))
        if index is not None
    }


def _touch(overrides: Overrides, urdf: Urdf) -> Mapping[str, TouchSection]:
    """Return where the touch sensors are, once their links are known to exist."""
    for name, section in overrides.config.touch.items():
        if section.link is not None and section.link not in urdf.links:
            what = f"unknown link '{section.link}'; {suggestion(section.link, urdf.links)}"
            raise overrides.refusal(("touch", name, "link"), what, urdf)
    return overrides.config.touch


def _tip_friction(fingers: Sequence[Finger], overrides: Overrides, urdf: Urdf) -> dict[str, float]:
    """Return the friction of the fingertips: as configured, otherwise as in the URDF, if given."""
    given, names = overrides.config.tip_friction, [finger.name for finger in fingers]
    for name in given:
        if name not in (*names, "defaults"):
            what = f"unknown finger; {suggestion(name, names)}"
            raise overrides.refusal(("tip_friction", name), what, urdf)
    found = {
        finger.name: given.get(finger.name, given.get("defaults", urdf.links[finger.tip].friction))
        for finger in fingers
        if finger.tip is not None
    }
    return {name: value for name, value in found.items() if value is not None}


def _check_ignored(roles: Mapping[str, JointRole], overrides: Overrides, urdf: Urdf) -> None:
    """Refuse to ignore anything but an actuator."""
    actuators = [name for name, role in roles.items() if role is JointRole.ACTUATOR]
    for i, name in enumerate(overrides.config.ignore):
        if name in actuators:
            continue
        if overrides.error is None:
            raise UnknownActuator(name, actuators, path=urdf.path)
        what = f"joint '{name}' is {roles[name]}, no actuator" if name in roles else ""
        what = what or f"unknown actuator '{name}'; {suggestion(name, actuators)}"
        raise overrides.error(("ignore", i), what)


def _check_actuators(
    actuators: list[str], apart: Sequence[str], overrides: Overrides, urdf: Urdf
) -> None:
    """Refuse a configuration of actuators that the hand does not have."""
    limited = [name for name in overrides.config.limits if name != DEFAULTS]
    for section, names in (("rest", overrides.config.rest), ("limits", limited)):
        for name in names:
            ignored = name in overrides.config.ignore or name in apart
            if name in actuators or (ignored and section == "rest"):
                continue
            # Without a hand.yaml there is no line to name.
            if overrides.error is None:
                raise UnknownActuator(name, actuators, path=urdf.path)
            hint = "the actuator is ignored" if ignored else "unknown actuator; "
            hint += "" if ignored else suggestion(name, actuators)
            raise overrides.error((section, name), hint)


def _role(joint: UrdfJoint, passive: set[str]) -> JointRole:
    # First: if a file has both, the joint to follow says more than a missing motor.
    if joint.mimic is not None:
        return JointRole.MIMIC
    return JointRole.PASSIVE if joint.name in passive else JointRole.ACTUATOR


def _joint(joint: UrdfJoint, role: JointRole) -> Joint:
    return Joint(
        name=joint.name,
        kind=JointKind(joint.kind),
        role=role,
        parent=joint.parent,
        child=joint.child,
        lower=joint.lower,
        upper=joint.upper,
        line=joint.line,
    )


def _make_dynamics(
    overrides: Overrides, actuators: Sequence[str], urdf: Urdf, transmission: Transmission
) -> dict[str, ActuatorDynamics]:
    """Return the dynamics of every actuator, with the names of the joints on springs.

    Raises:
        UserError: if the configuration names an actuator or a joint that does not exist.
    """

    def refuse(place: tuple[str | int, ...], what: str) -> UserError:
        return overrides.refusal(("dynamics", *place), what, urdf)

    given = overrides.config.dynamics
    for name in given:
        if name not in (*actuators, DEFAULTS):
            raise refuse((name,), f"unknown actuator; {suggestion(name, actuators)}")
    defaults = given.get(DEFAULTS, ActuatorDynamics())
    moving = [name for name, joint in urdf.joints.items() if joint.moving]
    found: dict[str, ActuatorDynamics] = {}
    for index, name in enumerate(actuators):
        dynamics = _completed(given.get(name), defaults)
        follow = [joint for i, joint in enumerate(moving) if transmission.moves(i) == index]
        key, patterns = "joints", dynamics.joints
        if dynamics.shares is not None:
            key, patterns = "shares", tuple(dynamics.shares)
        chosen: dict[str, float] = {}
        if patterns is None:
            chosen = {
                joint: 1.0
                for joint in follow
                # An actuator's own joint without a shape below it is only a motor, without a
                # spring.
                if joint != name
                or any(urdf.links[n].collisions for n in urdf.links_below(urdf.joints[joint].child))
            }
        for place, pattern in enumerate(patterns or ()):
            matching = [joint for joint in follow if fnmatchcase(joint, pattern)]
            if not matching:
                what = f"no joint that follows '{name}' is called '{pattern}'"
                at = place if key == "joints" else pattern
                raise refuse((name, key, at), f"{what}; {suggestion(pattern, follow)}")
            chosen |= dict.fromkeys(matching, (dynamics.shares or {}).get(pattern, 1.0))
        if dynamics.coupling in (None, Following.RIGID):
            chosen = {}
        # In the hand's order, independent of that of the patterns.
        chosen = {joint: chosen[joint] for joint in follow if joint in chosen}
        shares = chosen if dynamics.shares is not None else None
        found[name] = structs.replace(dynamics, joints=tuple(chosen), shares=shares)
    return found


def _completed(own: ActuatorDynamics | None, defaults: ActuatorDynamics) -> ActuatorDynamics:
    """Return an actuator's dynamics with the defaults for missing values."""
    if own is None:
        return defaults
    missing = [name for name, value in structs.asdict(own).items() if value is None]
    return structs.replace(own, **{name: getattr(defaults, name) for name in missing})
