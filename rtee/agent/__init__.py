"""The hand for language models: a server of the Model Context Protocol, a client of `remote`."""
