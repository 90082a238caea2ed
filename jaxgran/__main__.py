"""``python -m jaxgran`` is the command ``jaxgran``."""

from jaxgran.cli import main

if __name__ == "__main__":
    main()
