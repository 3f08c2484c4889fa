"""Extraction of primitive grasping actions from a hand's model."""
