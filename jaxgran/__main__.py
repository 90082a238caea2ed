"""``python -m jaxgran`` is the command ``jaxgran``."""

from jaxgran.cli.app import main

if __name__ == "__main__":
    main()
