"""``python -m neusee`` is ``neusee``."""

from neusee.workflows.cli.app import main

if __name__ == "__main__":
    main()
