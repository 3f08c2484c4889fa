"""Objects that hands grasp: how users write their shapes, and what simulated ones look like."""
