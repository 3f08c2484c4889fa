"""The qb SoftHand on a serial line."""
