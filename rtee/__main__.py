"""The command line as a module: ``python -m rtee``."""

from rtee.cli import main

main()
