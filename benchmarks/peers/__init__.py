"""Peers: other programs that simulate the same sheared discs, one module each, compared by
``speed_vs_accuracy``.

A module of a peer offers:

- ``CURVES``, its curves in the chart and the settings along each, from cheap to accurate;
- ``missing()``, a sentence where the peer is not installed, else None;
- ``begin(discs, flow, curve, setting, duration)``, a ``Run`` from given discs, whose every
  ``advance()`` takes one duration and returns the mean stresses of it.
"""
