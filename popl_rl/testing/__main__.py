"""``python -m popl_rl.testing``."""

import sys

from popl_rl.testing.command import main

if __name__ == "__main__":
    sys.exit(main())
