"""The hand on the network: a server in the process of the loop, and its clients."""
