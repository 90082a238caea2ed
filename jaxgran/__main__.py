"""The program ``jaxgran``, also as ``python -m jaxgran``."""

import sys


def main() -> None:
    """Load the command line and run it; Ctrl-C also ends the loading in one sentence."""
    try:
        from jaxgran.cli.app import program

        program()
    except KeyboardInterrupt:
        print("jaxgran: interrupted.", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
