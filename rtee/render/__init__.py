"""Pictures of a hand by ray casting on the CPU, without a GPU or a display."""
