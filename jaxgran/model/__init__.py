"""What a flow is: its parameters, its grains, its sheared cell, its state, and what can go wrong.

It imports no other folder of the package. Begin with `flow`, then `grains`, `cell` and `state`.
"""
