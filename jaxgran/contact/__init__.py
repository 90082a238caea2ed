"""The contacts of one time step and their impulses.

It imports `model` only. Begin with `law`, the rule that makes a pair a contact; then `network` and
`solver`.
"""
