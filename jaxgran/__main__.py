"""``python -m jaxgran`` is the command ``jaxgran``."""

from jaxgran.cli.app import program

if __name__ == "__main__":
    program()
