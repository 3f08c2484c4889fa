"""PSYONIC Ability Hand: stuffed frames on a UART or RS-485; six motors, thirty touch sensors."""
