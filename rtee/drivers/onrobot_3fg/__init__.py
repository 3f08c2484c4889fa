"""OnRobot 3FG15 and 3FG25."""
