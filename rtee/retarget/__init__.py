"""A human hand's points as positions of any hand's actuators.

Offline, `rtee.retarget.fit` finds from the model which finger follows which; online, a `Retargeter`
turns 21 points into positions, once per frame.
"""

from rtee.retarget.layouts import LAYOUTS, Layout, Side
from rtee.retarget.retargeter import Retargeter, TrackingError

__all__ = ["LAYOUTS", "Layout", "Retargeter", "Side", "TrackingError"]
