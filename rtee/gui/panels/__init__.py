"""The panels of the GUI, one module each."""
