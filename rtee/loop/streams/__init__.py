"""Streams of set-points: from the samples of a client to a reference at every tick."""
