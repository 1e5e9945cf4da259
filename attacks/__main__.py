"""`python -m attacks`: the same as the console script `mi-splat`."""

import sys

from attacks.cli import main

if __name__ == "__main__":
    sys.exit(main())
