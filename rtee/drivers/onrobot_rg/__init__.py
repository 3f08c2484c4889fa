"""OnRobot RG2 and RG6."""
