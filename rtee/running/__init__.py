"""Preparing a hand from its configuration, and running it with its loop, recorder and server."""
