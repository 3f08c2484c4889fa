"""The grasping actions: types, composition, library, YAML."""

from __future__ import annotations

from rtee.actions.library import ActionLibrary
from rtee.actions.types import (
    Action,
    ActionKind,
    ActionReference,
    Composed,
    Evidence,
    Generic,
    Posture,
    Primitive,
    PrimitiveGroup,
    PrimitiveKind,
    Step,
    Timed,
    kind_of,
)
