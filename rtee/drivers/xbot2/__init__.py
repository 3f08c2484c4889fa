"""Joints behind XBot2."""
