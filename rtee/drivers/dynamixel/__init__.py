"""Hands of Dynamixel servos."""
