"""One replica through time: free flight, collisions, and the running sums of what they do.

It imports `contact` and `model`. Begin with `advance`, which selects the engine; `jax_engine` is
the reference.
"""
