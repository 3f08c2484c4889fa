"""Installation of a hand as a service of a robot PC, and its removal."""
