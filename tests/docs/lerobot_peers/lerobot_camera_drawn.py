"""A camera of LeRobot that looks at a running hand, found by the name of its distribution."""

from dataclasses import dataclass

from drawn import picture
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig

import rtee


@CameraConfig.register_subclass("drawn")
@dataclass(kw_only=True)
class DrawnCameraConfig(CameraConfig):
    pass


class DrawnCamera(Camera):
    def __init__(self, config):
        super().__init__(config)
        self.hand = None

    @property
    def is_connected(self):
        return self.hand is not None

    @staticmethod
    def find_cameras():
        return []

    def connect(self, warmup=True):
        self.hand = rtee.connect_blocking(client="camera")

    def read(self):
        return picture(self.hand.state().position)

    def async_read(self, timeout_ms=200.0):
        return self.read()

    def read_latest(self, max_age_ms=500):
        return self.read()

    def disconnect(self):
        self.hand, hand = None, self.hand
        hand.disconnect()
