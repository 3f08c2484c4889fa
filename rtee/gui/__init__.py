"""The hand in the browser, as a client of the network."""
