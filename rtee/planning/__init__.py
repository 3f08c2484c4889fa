"""Choose an action for an object: plan grasps from geometry, forces and the hand's actions."""
