"""The Allegro Hand over CAN."""
