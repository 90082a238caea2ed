"""What kinetic theory predicts for a sheared flow: stresses, temperature, collision rate.

It imports nothing else of the package. Begin with `gaussian_moments`, the theory that fits best.
"""
