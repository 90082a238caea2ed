"""What can go wrong in a replica, in order of severity; the worst status is kept."""

from enum import IntEnum


class Status(IntEnum):
    """Outcome of a replica; a larger value is worse. Compiled code carries it as an int32.

    Examples:
      >>> max(Status.ok, Status.not_steady, Status.iteration_limit).name
      'not_steady'
    """

    ok = 0
    iteration_limit = 1  # a contact solve ended above the tolerance
    not_steady = 2  # the flow was not shown to be steady
    deep_overlap = 3  # two grains overlapped by more than 1e-2 mean diameters
    infeasible = 4  # no impulses satisfy the contact law: the packing is jammed
    capacity = 5  # more pairs or contacts than the buffers hold
    nonfinite = 6  # a position, velocity or impulse is not a finite number


DEEP_OVERLAP = 1e-2  # σ
