"""Kinetic theory of sheared flow: stresses, granular temperature, collision rate.

It imports no other folder of the package. Begin with `gaussian_moments`, the most accurate theory
here.
"""
