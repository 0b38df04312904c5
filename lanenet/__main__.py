"""``python -m lanenet`` is the command line."""

from lanenet.cli.app import main

if __name__ == "__main__":
    main()
