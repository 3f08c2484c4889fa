"""The command line as a module: ``python -m rtee``."""

import os
import sys

# With ``-m``, Python puts the working folder first on its path, where a file could shadow a
# library. rtee itself has already been found.
if not sys.flags.safe_path and sys.path[:1] == [os.getcwd()]:
    del sys.path[0]

from rtee.cli import main

main()
