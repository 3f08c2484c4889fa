"""Drivers: one folder per device family with codec, driver and emulator side by side."""
