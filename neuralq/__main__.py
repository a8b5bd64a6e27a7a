"""``python -m neuralq`` is the command line."""

import sys

from neuralq.apps.cli import main

if __name__ == "__main__":
    sys.exit(main())
