"""Grippers of CiA 402 drives over CANopen."""
