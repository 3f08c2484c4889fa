"""Which action for an object: grasps planned from geometry, forces and the hand's actions."""
