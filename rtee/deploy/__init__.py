"""A computer made a robot PC: what a hand's service needs there, written and taken away again."""
