"""Moving a hand from a gamepad, the keyboard or a file: what a person does, as a stream."""
