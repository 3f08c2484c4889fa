"""Trials of grasps in simulation: approach, grasp, lift, shake, and report whether it was held."""
