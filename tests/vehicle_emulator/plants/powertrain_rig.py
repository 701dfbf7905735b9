"""A powertrain and its gearbox on a load: a car as a point mass on the road, a car that is held, or wheels that turn freely."""

from array import array
from typing import Any

import casadi as ca

from dbc.powertrain import PowertrainParameters
from vehicle_emulator.plants.interface import Selector
from vehicle_emulator.plants.multibody import powertrain
from vehicle_emulator.plants.multibody.gearbox import Gearbox, GearboxState

STEP_S = 0.001
HELD_KG = 1e9


def step_function(p: PowertrainParameters) -> ca.Function:
    """One step of Runge and Kutta's fourth order.

    State: engine speed, gas torque, speed of the car. Inputs: pedal, ratio, clutch, lock-up, force on the car, torque on the engine, mass,
    share of the wheels' speed that the car has.
    """
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 8)
    radius_m = p.pedal.wheel_radius_m
    engine_radps2, gas_nmps, axle_nm = powertrain.derivatives(p, x[0], x[1], u[0], u[1], u[2], u[3], x[2] / radius_m, u[7] * x[2])
    rates = ca.vertcat(engine_radps2 + u[5] / p.engine.inertia_kgm2, gas_nmps, (axle_nm / radius_m + u[4]) / u[6])
    rhs = ca.Function("rhs", [x, u], [rates, axle_nm / radius_m])
    k1, drive_n = rhs(x, u)
    k2 = rhs(x + 0.5 * STEP_S * k1, u)[0]
    k3 = rhs(x + 0.5 * STEP_S * k2, u)[0]
    k4 = rhs(x + STEP_S * k3, u)[0]
    return ca.Function("step", [x, u], [x + STEP_S / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), drive_n])


class Rig:
    """See the module.

    Args:
        mass_kg: of the car; `HELD_KG` for one that does not move.
        resistance: force against motion [N], constant, and over squared speed [N s2/m2].
        is_lifted: whether the car stands while its wheels turn; `mass_kg` is then their inertia over squared radius.
    """

    def __init__(
        self,
        p: PowertrainParameters,
        step: ca.Function,
        mass_kg: float,
        resistance: tuple[float, float] = (0.0, 0.0),
        speed_mps: float = 0.0,
        gear: int | None = None,
        is_lifted: bool = False,
    ) -> None:
        self.p, self.mass_kg, self.resistance, self.car_share = p, mass_kg, resistance, 0.0 if is_lifted else 1.0
        self.gearbox = Gearbox(p.gearbox, p.pedal.wheel_radius_m)
        self.time_s = 0.0
        self.x, self._u, self._y, self._drive_n = (array("d", [0.0] * size) for size in (3, 8, 3, 1))
        self._buffer, self._evaluate = step.buffer()
        for i, memory in enumerate((self.x, self._u)):
            self._buffer.set_arg(i, memoryview(memory))
        for i, memory in enumerate((self._y, self._drive_n)):
            self._buffer.set_res(i, memoryview(memory))
        self.x[:] = array("d", [p.engine.idle_radps, 0.0, speed_mps])
        if gear is not None:
            self.gearbox.start(gear)
            self.x[0] = max(self.gearbox.state.ratio * self.wheels_radps, p.engine.idle_radps)

    engine_radps = property(lambda self: self.x[0])
    gas_nm = property(lambda self: self.x[1])
    speed_mps = property(lambda self: self.x[2])
    wheels_radps = property(lambda self: self.x[2] / self.p.pedal.wheel_radius_m)
    drive_n = property(lambda self: self._drive_n[0])
    state: GearboxState = property(lambda self: self.gearbox.state)  # type: ignore[assignment]

    def step(self, pedal: float, *, selector: Selector = Selector.DRIVE, push_n: float = 0.0, load_nm: float = 0.0, **fixed: Any) -> None:
        """One millisecond; `fixed` overrides what the gearbox says: ratio, clutch, lockup."""
        box = self.gearbox.step(STEP_S, selector, pedal, self.wheels_radps, self.engine_radps)
        moving = max(-1.0, min(self.speed_mps / 0.1, 1.0))
        resistance_n = self.resistance[0] * moving + self.resistance[1] * self.speed_mps * abs(self.speed_mps)
        self._u[:] = array(
            "d",
            [
                *(pedal, fixed.get("ratio", box.ratio), fixed.get("clutch", box.clutch_norm), fixed.get("lockup", box.lockup_norm)),
                *(push_n - resistance_n, -load_nm, self.mass_kg, self.car_share),
            ],
        )
        self._evaluate()
        self.x[:] = self._y
        self.time_s += STEP_S

    def run(self, duration_s: float, pedal: float = 0.0, **held: Any) -> "Rig":
        """Hold the inputs."""
        for _ in range(round(duration_s / STEP_S)):
            self.step(pedal, **held)
        return self
