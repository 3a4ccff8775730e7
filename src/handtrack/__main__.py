"""`python -m handtrack` is the `handtrack` command."""

import sys

from handtrack.cli import main

if __name__ == "__main__":
    sys.exit(main())
