"""Any hand that rtee runs, as a robot of LeRobot, and teleoperators for it."""

from lerobot_robot_rtee.rtee_gamepad import RteeGamepad, RteeGamepadConfig
from lerobot_robot_rtee.rtee_hand import RteeHand, RteeHandConfig
from lerobot_robot_rtee.rtee_landmarks import RteeLandmarks, RteeLandmarksConfig

__all__ = [
    "RteeGamepad",
    "RteeGamepadConfig",
    "RteeHand",
    "RteeHandConfig",
    "RteeLandmarks",
    "RteeLandmarksConfig",
]
