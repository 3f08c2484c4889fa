"""The hand on the network: a server beside the loop, a client for everybody else."""
