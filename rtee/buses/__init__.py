"""Buses: ownership, deadlines, retries, reconnection, trace; and their simulated ends."""
