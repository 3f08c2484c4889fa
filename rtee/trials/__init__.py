"""Grasps tried in simulation: approach, grasp, lift, shake, and say whether the object was held."""
