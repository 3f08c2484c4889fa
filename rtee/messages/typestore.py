"""Type store of the messages for `rosbags`, to read recordings with that library."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rtee.errors import needing_extra
from rtee.messages.schema import DEFINITIONS

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


def typestore() -> Typestore:
    """Return a type store of ROS 2 with the messages of rtee registered in it.

    Raises:
        MissingExtra: if rosbags is missing.
    """
    with needing_extra("the type store of rosbags", "rosbags"):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in DEFINITIONS.items():
        # rosbags has the types of ROS itself and lacks only those of rtee.
        if name not in store.types:
            store.register(get_types_from_msg(definition, name))
    return store
