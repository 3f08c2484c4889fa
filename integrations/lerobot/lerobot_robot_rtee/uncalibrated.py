"""What LeRobot asks of every device, for those that need no calibration."""


class Uncalibrated:
    """A device that is calibrated, if at all, where its hand runs; comes before LeRobot's class."""

    @property
    def is_calibrated(self) -> bool:
        """Always."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing: hand.yaml configures the hand."""
