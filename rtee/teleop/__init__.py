"""Teleoperation of a hand by gamepad, keyboard or recorded samples, through a stream."""
