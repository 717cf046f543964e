"""`python -m jaxtrapolate`."""

import sys

from jaxtrapolate.commands.script import script

if __name__ == "__main__":
    sys.exit(script())
