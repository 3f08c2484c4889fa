"""Plays back the states of a recording as if the recorded hand were connected."""
