"""``python -m neuralq`` is the command line."""

import sys

from neuralq.cli import main

if __name__ == "__main__":
    sys.exit(main())
