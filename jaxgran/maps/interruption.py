"""How an interruption, by Ctrl-C or SIGTERM, reaches the caller of a map."""

from typing import Any


class Interrupted(KeyboardInterrupt):
    """A map was interrupted.

    Attributes:
      data: the dataset of what was done; all other points have the status ``not_run``.
    """

    def __init__(self, data: Any):
        super().__init__("the map was interrupted; this exception has the finished part as data")
        self.data = data


def is_interruption(error: BaseException | None) -> bool:
    """Whether an interruption led to the error: compiled code that is interrupted raises an error
    of its own.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
