"""The log: recorder, reader, recovery, plots, export and replay of MCAP files."""
