"""``python -m neusee``, which is ``neusee``; Ctrl-C during the first imports ends the program
with one sentence.
"""

import sys


def main() -> None:
    """Import the command line and run it."""
    try:
        from neusee.workflows.cli.app import main as run
    except KeyboardInterrupt:
        print("stopped before any work", file=sys.stderr)
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
