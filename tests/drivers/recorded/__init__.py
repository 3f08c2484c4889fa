"""Bytes of real devices, with their sources."""
