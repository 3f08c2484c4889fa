"""Teleoperation of a hand from a gamepad, keyboard or recorded samples, through a stream."""
