"""The touch board of the ORCA hand: taxels on the fingertips, and joint encoders."""
