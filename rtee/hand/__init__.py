"""The hand: model, kinematics and geometry, configuration."""
