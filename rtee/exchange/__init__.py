"""Models of other tools: a hand is written as URDF, SRDF and MJCF, and read from other forms."""
