"""Write the fingers of a hand as an SRDF that people can read and edit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape, quoteattr

from rtee.hand.chains import GROUP_OF_FINGERS
from rtee.hand.model import Finger, Hand, JointRole

_END = re.compile(r"<!--.*?-->|(</robot\s*>)", re.DOTALL)
"""Comments, which may contain the end tag, and the end tag."""

_HEAD = """<?xml version="1.0"?>
<!-- Which links of the URDF are fingers. Edit names and chains; rtee checks them when it reads. -->
"""


def format_srdf(
    hand: Hand, pairs: Sequence[tuple[str, str, str]], *, with_rest: bool = True
) -> str:
    """Return the SRDF of a hand.

    Args:
        hand: The hand.
        pairs: Pairs of links that need not be checked for collision.
        with_rest: Whether to write the rest posture; otherwise it is in hand.yaml.
    """
    members = "".join(
        [f"    <group name={quoteattr(finger.name)}/>\n" for finger in hand.fingers]
        + [f"    <joint name={quoteattr(name)}/>\n" for name in _beside(hand)]
    )
    passive = _passive([j.name for j in hand.joints if j.role is JointRole.PASSIVE])
    rest = "  <!-- The rest posture is in hand.yaml. -->\n"
    if with_rest:
        positions = "".join(
            f"    <joint name={quoteattr(actuator.name)} value={quoteattr(repr(actuator.rest))}/>\n"
            for actuator in hand.actuators
        )
        rest = f"""  <!-- The rest posture, from which grasping actions start [rad | m]. -->
  <group_state name="rest" group="{GROUP_OF_FINGERS}">
{positions}  </group_state>
"""
    return f"""{_HEAD}<robot name={quoteattr(hand.urdf.name)}>
{"".join(map(_group, hand.fingers))}  <group name="{GROUP_OF_FINGERS}">
{members}  </group>
  <end_effector name="end_effector" parent_link={quoteattr(hand.base)} group="{GROUP_OF_FINGERS}"/>

  <!-- Joints that no motor drives: <passive_joint name="JOINT"/> -->
{passive}
{rest}{_disabled(pairs)}</robot>
"""


def _disabled(pairs: Sequence[tuple[str, str, str]]) -> str:
    """Return the lines that disable collisions, with a comment."""
    lines = "".join(
        f"  <disable_collisions link1={quoteattr(link1)} link2={quoteattr(link2)} "
        f"reason={quoteattr(reason)}/>\n"
        for link1, link2, reason in pairs
    )
    comment = "\n  <!-- Pairs of links that are never checked for collision, and why. -->\n"
    return comment + lines if lines else ""


def _passive(joints: Iterable[str]) -> str:
    return "".join(f"  <passive_joint name={quoteattr(joint)}/>\n" for joint in joints)


def with_disabled(srdf: str, pairs: Sequence[tuple[str, str, str]]) -> str:
    """Return the text of an SRDF with added pairs."""
    return _with_lines(srdf, _disabled(pairs))


def with_passive(srdf: str, joints: Sequence[str]) -> str:
    """Return the text of an SRDF with added joints without a motor."""
    return _with_lines(srdf, _passive(joints))


def _with_lines(srdf: str, lines: str) -> str:
    # As text, to keep the comments and layout of the user's file.
    ends = [found.start() for found in _END.finditer(srdf) if found[1]]
    if not ends or not lines:
        return srdf
    return srdf[: ends[-1]] + lines.lstrip("\n") + srdf[ends[-1] :]


def _group(finger: Finger) -> str:
    # XML comments must not contain two hyphens in a row.
    reason = re.sub("-(?=-)", "- ", escape(finger.reason))
    base, end = quoteattr(finger.links[0]), quoteattr(finger.links[-1])
    # A part that does not move is named alone: the joint above it, as of an arm, is not its own.
    chain = (
        f"<chain base_link={base} tip_link={end}/>" if finger.actuators else f"<link name={end}/>"
    )
    return f"""  <!-- {reason} -->
  <group name={quoteattr(finger.name)}>
    {chain}
  </group>
"""


def _beside(hand: Hand) -> list[str]:
    """Return the actuators of which no joint is on a finger, such as those of a wrist."""
    links = {link for finger in hand.fingers for link in finger.links[1:]}
    moves = hand.transmission.moves
    used = {moves(row) for row, joint in enumerate(hand.joints) if joint.child in links}
    return [name for index, name in enumerate(hand.actuator_names) if index not in used]
