"""Programs that share no code with jaxgran: references for its numbers, and rivals for its speed.

``event_driven`` takes hard discs from collision to collision. ``contact_dynamics`` solves the time
step of jaxgran in one classical loop.
"""
