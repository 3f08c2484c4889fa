"""SCHUNK / Weiss Robotics WSG 50."""
