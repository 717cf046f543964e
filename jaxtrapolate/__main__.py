"""`python -m jaxtrapolate`."""

from jaxtrapolate.commands.main import main

if __name__ == "__main__":
    main()
