"""Recordings as datasets for policies that learn: LeRobot's format v3.0."""
