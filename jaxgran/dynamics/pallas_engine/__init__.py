"""The engine for NVIDIA GPUs: a thread block for each replica, a thread for each grain.

It imports `contact` and `model`, and the running sums. Begin with `kernel`; `memory` says what lies where.
"""
