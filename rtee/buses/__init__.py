"""Buses: ownership, deadlines, retries, reconnect, trace; and their simulated ends."""
