"""Friction at the wheels: brakes with an anti-lock system, the locked gearbox, rolling resistance. One bristle for each wheel has it all.

Pressure follows the pedal with a lag, p' = (p_full pedal - p) / tau. The anti-lock system is idealised: it lets off pressure at each
wheel as a smooth function of that wheel's slip, without pump, threshold logic or oscillation, and needs no state.
"""

import casadi as ca

from dbc.multibody import Brakes
from vehicle_emulator.plants.multibody.bristle import Bristle
from vehicle_emulator.plants.multibody.layout import SX

WHEEL_BRISTLE = Bristle(way=0.012, way_s=0.002, damping_s=0.0005)
"""Assumption: disc and pads give way by 0.7 degrees, 4 mm at the tyre. A shorter way is stiff: at full pressure the wheel on its
bristle has a pole of 350 1/s."""
_ROLLING_MPS = 0.1
"""Speed over which the direction of braking fades in; the anti-lock system is off there."""


def pressure_rate(p: Brakes, pedal: SX, pressure_bar: SX) -> SX:
    """Derivative of the pressure [bar/s]."""
    return (p.full_pedal_bar * pedal - pressure_bar) / p.lag_s


def pressure_share(p: Brakes, rolling_mps: SX, slip_x: SX) -> SX:
    """Share of the pressure that the anti-lock system leaves a wheel."""
    speed_mps = ca.fabs(rolling_mps)
    braking_slip = -slip_x * rolling_mps / (speed_mps + _ROLLING_MPS)
    release = _smooth((braking_slip - p.abs_slip) / (p.abs_slip_full - p.abs_slip))
    return 1.0 - p.has_abs * release * _smooth(speed_mps / p.abs_mps - 1.0)


def _smooth(x: SX) -> SX:
    """From 0 at 0 to 1 at 1, with a continuous derivative."""
    x = ca.fmin(ca.fmax(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
