"""Access to hands for language models: a Model Context Protocol server, as a client of `remote`."""
