"""Entry point of ``python -m neusee.workflows.cli``, which is the same as ``neusee``."""

from neusee.workflows.cli.app import main

if __name__ == "__main__":
    main()
