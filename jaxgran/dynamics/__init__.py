"""One replica through time: free flight, collisions, and the running sums of what they do.

It imports `contact` and `model`. Begin with `advance`, which selects the engine; `plain` is the reference engine.
"""
