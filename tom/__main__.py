"""The console script `tom`, also `python -m tom`."""

import sys


def script() -> None:
    """Run the command line; Ctrl-C ends it in one line while it is imported, too."""
    try:
        from tom.cli import main

        code = main()
    except KeyboardInterrupt:
        print("tom: stopped", file=sys.stderr)
        code = 1
    raise SystemExit(code)


if __name__ == "__main__":
    script()
