"""``python -m neuralq`` is the command line."""

import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:  # the present folder comes after what is installed, as it does for `neuralq`
        sys.path.append(sys.path.pop(0))
    from neuralq.apps.cli import main

    sys.exit(main())
