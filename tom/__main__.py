"""`python -m tom` is the console script `tom`."""

from tom.cli import script

script()
