"""From a hand's model to its primitive grasping actions."""
