"""`python -m egosim_jax` is `egosim`."""

import sys

from egosim_jax.cli.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
