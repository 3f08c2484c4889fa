"""A hand prepared from its configuration, and run: loop, recorder and server, wired together."""
