"""The SCHUNK SVH on a serial line."""
