"""Dry friction that holds at rest: a bristle that bends, slides, and springs back.

    s' = (v - |v| s) / (z_0 + z_1 |v|),    T = T_max (s + tau s'),    |s| <= 1

At rest s stays as it is, so that a held car does not creep; at speed s is the sign of v. z_0 is the way over which friction builds up,
z_1 makes the pole |v| / (z_0 + z_1 |v|) smaller than 1 / z_1 at any speed, where tanh(v) would either creep or be stiff.
Source: Dahl, A Solid Friction Model (1968); Canudas de Wit et al., A New Model for Control of Systems with Friction, IEEE TAC 40
(1995), of which T has the damping of the bristle.
"""

from typing import NamedTuple

import casadi as ca

from vehicle_emulator.plants.multibody.layout import SX


class Bristle(NamedTuple):
    """Numbers of a bristle.

    Args:
        way: z_0, in the unit of the way that it slides.
        way_s: z_1.
        damping_s: tau; at most z_1 / 4, so that a reversal does not jerk.
    """

    way: float
    way_s: float
    damping_s: float

    def rate(self, speed: SX, bend: SX) -> SX:
        """s'."""
        return (speed - ca.fabs(speed) * bend) / (self.way + self.way_s * ca.fabs(speed))

    def share(self, bend: SX, rate: SX) -> SX:
        """T / T_max, positive against positive speed."""
        return bend + self.damping_s * rate
