"""From a packing to averages: the steady state, the sample, and its observables.

It imports `dynamics` and what is below, but neither `analysis` nor `io`. Begin with `sample`, then `steady_state`.
"""
