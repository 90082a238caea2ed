"""The program ``jaxgran``, also as ``python -m jaxgran``."""

import os
import sys


def _open_closed_streams() -> None:
    """Let streams that a shell has closed lead nowhere; else a file that is opened takes the number
    of one.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            stream = open(number, "r" if number == 0 else "w", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)


def main() -> None:
    """Load the command line and run it; Ctrl-C also ends the loading in one sentence."""
    _open_closed_streams()
    try:
        from jaxgran.cli.app import program

        program()
    except KeyboardInterrupt:
        print("jaxgran: interrupted.", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
