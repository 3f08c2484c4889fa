"""Dynamics with contact: the hand in MuJoCo behind the same interface as a device."""
