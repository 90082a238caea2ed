"""What a flow is: its parameters, its grains, its sheared cell, its state, and what can go wrong.

It imports nothing else of the package. Begin with `flow`, then `grains`, `cell` and `state`.
"""
