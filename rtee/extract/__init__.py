"""Extraction of the primitive grasping actions from a hand's model."""
