"""Conversion of a human hand's points to actuator positions of any hand.

Offline, `rtee.retarget.fit` derives from the model which finger follows which human finger. Online,
a `Retargeter` turns 21 points into positions, once per frame.
"""

from rtee.retarget.layouts import LAYOUTS, Layout, Side
from rtee.retarget.retargeter import Retargeter, TrackingError

__all__ = ["LAYOUTS", "Layout", "Retargeter", "Side", "TrackingError"]
