"""Pictures of a hand by ray casting on the processor, without a GPU or a display."""
