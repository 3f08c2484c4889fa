"""What a fault code of Robotiq's grippers means."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Fault:
    """A code of gFLT.

    Attributes:
        name: What it is called.
        hint: What to do.
        warning: It is no fault that stops the gripper.
        major: Only a reset with a new activation clears it.
    """

    name: str
    hint: str = ""
    warning: bool = False
    major: bool = False


NOT_ACTIVATED = 0x07
"""The code of a gripper that was never activated, or lost its activation."""
