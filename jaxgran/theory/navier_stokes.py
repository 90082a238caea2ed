"""Kinetic theory of monodisperse discs to Navier-Stokes order, that of Garzó and Dufty, for any
restitution.

It neglects correlations between the velocities of neighbours, so it fails near jamming and in dense
flow at small restitution. Units: ``steady_shear``.
"""

import jax.numpy as jnp

from jaxgran.theory.steady_shear import Scalar, SteadyShear, as_floats, contact_value, of_one_flow


@of_one_flow
def garzo_dufty(
    restitution: Scalar, packing_fraction: Scalar, shear_rate: Scalar = 1.0
) -> SteadyShear:
    """Steady shear of inelastic, monodisperse discs, to first order in the velocity gradient.

    ================  ====  =======================================================
    name              unit  meaning
    ================  ====  =======================================================
    restitution       –     0 ≤ α < 1
    packing_fraction  –     0 < ν < 1
    shear_rate        1/t   γ̇ > 0
    returns                 SteadyShear
    ================  ====  =======================================================

    At α = 1 nothing balances the work of the shear, and the temperature is infinite. In steady
    shear the restitution fixes the velocity gradient, which is not small at small restitution: in
    dilute flow this expansion then gives a temperature several times too high.

    Source: V. Garzó and J. W. Dufty, Phys. Rev. E 59, 5895 (1999); in two dimensions J. F. Lutsko,
    Phys. Rev. E 72, 021306 (2005).

    Examples:
      Bagnold scaling: 1/γ̇ is the only time scale, so stresses scale as γ̇².

      >>> slow, fast = garzo_dufty(0.9, 0.4), garzo_dufty(0.9, 0.4, shear_rate=2.0)
      >>> round(float(fast.pressure / slow.pressure), 6)
      4.0
    """
    alpha, nu, rate = as_floats(restitution, packing_fraction, shear_rate)
    chi = contact_value(nu)
    density = 4 / jnp.pi * nu
    kurtosis = (
        16 * (1 - alpha) * (1 - 2 * alpha**2) / (57 - 25 * alpha + 30 * alpha**2 * (1 - alpha))
    )
    cooling = chi / 2 * (1 - alpha**2) * (1 + 3 * kurtosis / 16)
    relaxation = 3 * chi / 8 * (7 / 3 - alpha) * (1 + alpha) * (1 + 7 * kurtosis / 16)
    kinetic = (1 - (1 + alpha) * (1 - 3 * alpha) * nu * chi / 4) / (relaxation - cooling / 2)
    bulk = 8 / jnp.pi * nu**2 * chi * (1 + alpha) * (1 - kurtosis / 16)
    # in units of the dilute elastic viscosity
    viscosity = kinetic * (1 + (1 + alpha) * nu * chi / 2) + bulk / 2
    temperature = jnp.pi / (64 * nu**2) * viscosity / cooling * rate**2
    dilute_viscosity = jnp.sqrt(temperature / (4 * jnp.pi))
    maxwellian = 2 * jnp.sqrt(jnp.pi * temperature) * density * chi  # collisions per grain and time
    return SteadyShear(
        granular_temperature=temperature,
        pressure=density * temperature * (1 + (1 + alpha) * nu * chi),
        shear_stress=viscosity * dilute_viscosity * rate,
        collision_rate=maxwellian * (1 - kurtosis / 16) / rate,
        dissipation_rate=cooling * (density * temperature) ** 2 / dilute_viscosity,
    )
