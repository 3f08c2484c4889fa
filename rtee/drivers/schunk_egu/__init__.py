"""SCHUNK EGU and EGK."""
