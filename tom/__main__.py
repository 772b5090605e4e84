"""The console script `tom`, also `python -m tom`."""

import os
import sys


def script() -> None:
    """Run the command line; Ctrl-C ends it in one line while it is imported, too."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as by `>&-`; child processes need it as well
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(nowhere, True)
            setattr(sys, name, os.fdopen(nowhere, "r+"))
    try:
        from tom.cli import main

        code = main()
    except KeyboardInterrupt:
        print("tom: stopped", file=sys.stderr)
        code = 1
    raise SystemExit(code)


if __name__ == "__main__":
    script()
