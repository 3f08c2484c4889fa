"""Robotiq 3-Finger."""
