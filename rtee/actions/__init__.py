"""The grasping actions: types, composition, library, YAML."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary


def __getattr__(name: str) -> Any:
    # Imported when first used, since the extraction needs only the types.
    if name == "ActionLibrary":
        from rtee.actions.library import ActionLibrary

        return ActionLibrary
    raise AttributeError(f"module 'rtee.actions' has no attribute '{name}'")
