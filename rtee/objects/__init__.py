"""Objects that hands grasp: how users write their shapes, and the shapes of simulated objects."""
