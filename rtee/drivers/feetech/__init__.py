"""Feetech's serial bus servos: SCS, STS, SMS and HLS, and hands with two servos to a finger."""
