"""What kinetic theory predicts for a sheared flow: stresses, temperature, collision rate.

It imports no other folder of the package. Begin with `gaussian_moments`, the most accurate theory here.
"""
