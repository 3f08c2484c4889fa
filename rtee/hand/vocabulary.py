"""The elements and attributes of models that are read, or that mean nothing to a hand.

Everything else in a URDF or SRDF is noted, so that nothing physical is ignored silently. In
an MJCF, MuJoCo refuses what it does not know; what it knows and a hand does not have is noted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rtee.hand.xmlfile import Element


@dataclass(frozen=True, slots=True)
class Known:
    """The known attributes and children of an element.

    Attributes:
        attributes: Its attributes that are read or harmless.
        children: Known elements inside it, by tag.
        foreign: Whether it belongs to one program, and may have any other elements inside.
    """

    attributes: frozenset[str] = frozenset()
    children: Mapping[str, Known | None] = field(default_factory=dict)
    foreign: bool = False

    def inside(self, tag: str) -> Known | None:
        """Return the vocabulary of a child element; ``None`` if the element is not read."""
        # A prefix is a program's, such as drake:capsule for what URDF 1.1 calls capsule.
        plain = tag.rpartition(":")[2]
        return self.children.get(plain, _FOREIGN if self.foreign else None)


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


def _known(attributes: str = "", **children: Known) -> Known:
    """Parse a vocabulary: attributes that are read, then, after a bar, harmless ones."""
    return Known(_words(attributes.replace("|", " ")), children)


_WORDS: Final = _words(
    "name type reference filename value plugin role initial_value xyz rpy min max param"
)
"""Usual attributes in the parts of a file that belong to one program."""

_FOREIGN: Final = Known(_WORDS, foreign=True)
"""A part that belongs to one program, such as a simulator's sensors or a controller's set-up."""

_ORIGIN: Final = _known("xyz rpy quat_xyzw")
_MATERIAL: Final = _known("|name", color=_known("|rgba"), texture=_known("|filename"))
_SHAPE: Final = _known(
    "|name",
    origin=_ORIGIN,
    geometry=_known(
        box=_known("size"),
        sphere=_known("radius"),
        cylinder=_known("radius length"),
        capsule=_known("radius length"),
        mesh=_known("filename scale"),
    ),
    material=_MATERIAL,
    verbose=_known("|value"),
)

URDF: Final = _known(
    "name|version",
    link=_known(
        "name",
        inertial=_known(
            origin=_ORIGIN, mass=_known("value"), inertia=_known("ixx ixy ixz iyy iyz izz")
        ),
        visual=_SHAPE,
        collision=_SHAPE,
        contact=_known(lateral_friction=_known("value")),
    ),
    joint=_known(
        "name type",
        parent=_known("link"),
        child=_known("link"),
        origin=_ORIGIN,
        axis=_known("xyz"),
        limit=_known("lower upper velocity effort acceleration deceleration jerk"),
        mimic=_known("joint multiplier offset nlFunPos"),
        safety_controller=_known("soft_lower_limit soft_upper_limit|k_position k_velocity"),
        # Springs say that a joint has no motor; `rtee.hand.candidates` reads them.
        dynamics=_known("spring_stiffness spring_reference springStiffness springReference"),
        calibration=_known("|rising falling reference_position"),
    ),
    material=_MATERIAL,
    transmission=_FOREIGN,
    ros2_control=_FOREIGN,
    sensor=_FOREIGN,
    # A joint there closes a loop, which a URDF cannot express otherwise.
    gazebo=Known(_WORDS, {"joint": None}, foreign=True),
)

SRDF: Final = _known(
    "name|version",
    group=_known(
        "name",
        chain=_known("base_link tip_link"),
        link=_known("name"),
        joint=_known("name"),
        group=_known("name"),
    ),
    group_state=_known("name group", joint=_known("name value")),
    end_effector=_known("name group parent_link|parent_group"),
    passive_joint=_known("name"),
    disable_collisions=_known("link1 link2 reason"),
    virtual_joint=_known("|name type parent_frame child_link"),
)

_MJCF_UNREAD: Final = {
    "joint": _words("damping frictionloss armature"),
    "geom": _words("friction"),
    "body": _words("gravcomp"),
    "fixed": _words("damping frictionloss"),
    "spatial": _words("damping frictionloss"),
    "option": _words("gravity wind density viscosity"),
}
"""Physical attributes of an MJCF that a hand does not take over."""

_SEVERAL: Final = _words(
    "link joint visual collision material transmission ros2_control sensor gazebo group chain "
    "group_state end_effector passive_joint disable_collisions virtual_joint"
)
"""Elements that may occur several times side by side; of all others, the first is read."""

_HINTS: Final = {
    "the attribute 'damping' of <joint>": "hand.yaml has damping in dynamics:",
    "the attribute 'frictionloss' of <joint>": "hand.yaml has dry_friction in dynamics:",
    "the attribute 'armature' of <joint>": "hand.yaml has armature in dynamics:",
    "the attribute 'friction' of <geom>": "hand.yaml has that of fingertips in tip_friction:",
    "the attribute 'damping' of <dynamics>": "hand.yaml has damping in dynamics:",
    "the attribute 'friction' of <dynamics>": "hand.yaml has dry_friction in dynamics:",
    "<contact_coefficients>": "hand.yaml has the friction of fingertips in tip_friction:",
}
"""Receiver of notes on elements that are not read."""


def unread(root: Element, known: Known) -> list[str]:
    """Return a sentence for each kind of element and attribute that is not read, with its line."""
    return _sentences(_unknown(root, known))


def unread_of_mjcf(elements: Iterable[Element]) -> list[str]:
    """Return a sentence for each kind of physical attribute of an MJCF that is not read."""
    return _sentences(
        (f"the attribute '{name}' of <{element.tag}>", element)
        for element in elements
        for name in element.attributes
        if name in _MJCF_UNREAD.get(element.tag, ())
    )


def _sentences(unread: Iterable[tuple[str, Element]]) -> list[str]:
    found: dict[str, list[Element]] = {}
    for what, element in unread:
        found.setdefault(what, []).append(element)
    return [_sentence(what, elements) for what, elements in found.items()]


def _sentence(what: str, elements: list[Element]) -> str:
    first, more = elements[0], len(elements) - 1
    place = f"line {first.line} of {Path(first.path).name}" + (f", and {more} more" if more else "")
    hint = next((hint for word, hint in _HINTS.items() if what.startswith(word)), "")
    return f"{what} is not read ({place})" + (f"; {hint}" if hint else "")


def _unknown(root: Element, known: Known) -> Iterator[tuple[str, Element]]:
    pending = [(root, known)]
    while pending:
        element, here = pending.pop()
        for name in element.attributes:
            if name not in here.attributes and not name.startswith(("xmlns", "xml:", "xsi:")):
                yield f"the attribute '{name}' of <{element.tag}>", element
        below, seen = [(child, here.inside(child.tag)) for child in element.children], set[str]()
        for child, inside in below:
            if inside is None:
                yield f"<{child.tag}> in <{element.tag}>", child
            elif not here.foreign and child.tag not in _SEVERAL:
                if element.tag == "geometry" and seen:
                    yield "a second shape in <geometry>", child
                elif child.tag in seen:
                    yield f"a second <{child.tag}> in <{element.tag}>", child
                seen.add(child.tag)
        # Depth first, so that notes come in the order of the file.
        pending += [(child, inside) for child, inside in reversed(below) if inside is not None]
