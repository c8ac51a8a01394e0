"""``python -m tightrope`` is the command line."""

import sys

from tightrope.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
