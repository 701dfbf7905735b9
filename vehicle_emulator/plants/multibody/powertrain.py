"""Engine, torque converter with lock-up, driveline, and what the engine controller makes of the accelerator pedal.

Two states: engine speed w and the torque M of the gas (manifold, turbocharger).

    J w' = u(w) (M + M_support) + M_starter - M_friction(w) - M_pump
    tau M' = M_asked - M

u(w) in 0..1 is combustion: it collapses below the idle speed and is cut at the rev limit. With the turbine speed w_t = ratio w_wheels,
s = w_t / w and the slip w - w_t the converter takes and gives

    M_pump = clip(c max(w, |w_t|) (w - w_t), -k_o w_t^2, k (1 - f s) w^2),    M_turbine = m(s) M_pump

m(s) falls from its value at stall to 1 at the coupling point. The lock-up clutch is friction with a ramp over its slip. The share
`clutch` of all this goes through the gearbox.

The engine controller is torque-based: pedal -> wheel force min(F, P / v) -> pump torque through the ratio and the torque ratio that the
converter has now. Zero pedal is creep below the idle speed of the turbine and an engine without fuel above it; in between the pedal is
linear, without a dead band. A share of the torque that accelerates the engine itself is added, so that first gear pulls as strongly as
the pedal says.

Simplifications: no turbine speed of its own (its inertia, 0.05 kg m2, is left out), no shaft that twists, no temperature. A stalled engine
is cranked by its starter at once and runs again within a second, whatever the driver does, because nobody in the loop turns a key.

Poles: up to 250 1/s on the road, 800 1/s on free wheels in first gear at the rev limit. Everything is continuous.
"""

from typing import NamedTuple

import casadi as ca

from dbc.powertrain import Converter, Engine, PowertrainParameters
from vehicle_emulator.plants.multibody.layout import SX

_LEAST_RADPS = 1.0
_LEAST_RATIO = 0.5
"""Far below any gear: neutral, in which the pedal asks for all that the engine has."""
_LEAST_MPS = 0.1
_DRY_FRICTION_RADPS = 5.0
"""Speed over which dry friction in engine and driveline takes its direction; a pole of 20 1/s."""
_MATCHING_PER_S = 10.0
"""Assumption: the engine follows the turbine through a shift with a time constant of 0.1 s."""
_MATCHING_CUT_RADPS = 60.0
"""Assumption: speed that the engine has to lose in a shift, from which on it gets no fuel."""
_CREEP_END = 0.75
"""Share of the idle speed at which the torque at zero pedal begins to fall."""
_CRANKING_RADPS = 10.0


class Shafts(NamedTuple):
    """What turns, and what is closed between it; see `derivatives`."""

    engine_radps: SX
    ratio: SX
    clutch_norm: SX
    lockup_norm: SX
    wheels_radps: SX

    @property
    def turbine_radps(self) -> SX:
        """Speed of the turbine."""
        return self.ratio * self.wheels_radps


class Flow(NamedTuple):
    """Torque that the transmission takes from the engine, and what it gives to the driven axle."""

    pump_nm: SX
    axle_nm: SX


def derivatives(  # noqa: PLR0917 - two states, four commands, two speeds
    p: PowertrainParameters,
    engine_radps: SX,
    engine_torque_nm: SX,
    accelerator_norm: SX,
    ratio: SX,
    clutch_norm: SX,
    lockup_norm: SX,
    driven_wheels_radps: SX,
    vx_mps: SX,
) -> tuple[SX, SX, SX]:
    """Derivatives of engine speed [rad/s2] and of gas torque [Nm/s], and the torque on the driven axle [Nm].

    The open differential gives half of the axle torque to each wheel.

    Args:
        engine_torque_nm: torque of the gas: flywheel torque plus friction.
        ratio: gearbox times final drive, engine speed over wheel speed; negative in reverse, 0 in neutral.
        clutch_norm: closed share of the gearbox's clutch, 0 in neutral.
        driven_wheels_radps: mean of the two driven wheels.
        vx_mps: speed of the car, for traction control.
    """
    at = Shafts(engine_radps, ratio, clutch_norm, lockup_norm, driven_wheels_radps)
    flow = transmission(p, at)
    # In gear the clutch is open in a shift, in which the engine follows the turbine, and in a creeping car, whose governor wants more.
    is_open = ca.fmin(ca.fabs(ratio) / _LEAST_RATIO, 1.0) * (1.0 - clutch_norm)
    ahead_radps = engine_radps - ca.fmax(at.turbine_radps, p.engine.idle_radps)
    is_cut = is_open * _clip(ahead_radps / _MATCHING_CUT_RADPS, 0.0, 1.0)
    surplus_nm = flywheel_nm(p.engine, engine_radps, (1.0 - is_cut) * engine_torque_nm) - flow.pump_nm
    pedal_norm = accelerator_norm * _traction(p, at, vx_mps)
    wanted_nm = pedal_norm * _full_pedal_nm(p, at) + (1.0 - pedal_norm) * _overrun_nm(p, at)
    wanted_nm -= is_open * (_MATCHING_PER_S * p.engine.inertia_kgm2 * ahead_radps + wanted_nm)
    wanted_nm += p.pedal.inertia_share * surplus_nm
    governor_nm = flow.pump_nm + p.engine.idle_stiffness_nms * (p.engine.idle_radps - engine_radps)
    asked_nm = friction_nm(p.engine, engine_radps) + ca.fmin(ca.fmax(wanted_nm, governor_nm), full_load_nm(p.engine, engine_radps))
    return surplus_nm / p.engine.inertia_kgm2, (ca.fmax(asked_nm, 0.0) - engine_torque_nm) / p.engine.lag_s, flow.axle_nm


def transmission(p: PowertrainParameters, at: Shafts) -> Flow:
    """Converter, lock-up clutch, gears and driveline; never gives more power than it takes."""
    converter_nm = pump_nm(p.converter, at.engine_radps, at.turbine_radps)
    slip = (at.engine_radps - at.turbine_radps) / p.converter.lockup_slip_radps
    lockup_nm = at.lockup_norm * p.converter.lockup_nm * _clip(slip, -1.0, 1.0)
    amplification = torque_ratio(p.converter, speed_ratio(at.engine_radps, at.turbine_radps))
    turbine_nm = at.clutch_norm * (amplification * converter_nm + lockup_nm)
    geared_nm = ca.fmin(p.driveline.efficiency * turbine_nm, turbine_nm / p.driveline.efficiency)
    direction = _clip(at.wheels_radps / _DRY_FRICTION_RADPS, -1.0, 1.0)
    drag_nm = p.driveline.drag_nm * direction + p.driveline.drag_nms * at.wheels_radps
    return Flow(at.clutch_norm * (converter_nm + lockup_nm), at.ratio * geared_nm - drag_nm)


def speed_ratio(engine_radps: SX, turbine_radps: SX) -> SX:
    """Turbine speed over pump speed, 0 to 1."""
    return _clip(turbine_radps / ca.fmax(engine_radps, _LEAST_RADPS), 0.0, 1.0)


def torque_ratio(p: Converter, at: SX) -> SX:
    """Turbine torque over pump torque at a speed ratio."""
    return 1.0 + (p.stall_torque_ratio - 1.0) * ca.fmax(1.0 - at / p.coupling_speed_ratio, 0.0)


def pump_nm(p: Converter, engine_radps: SX, turbine_radps: SX) -> SX:
    """Torque that the open converter takes from the engine."""
    capacity_nms2 = p.capacity_nms2 * (1.0 - p.capacity_fall * speed_ratio(engine_radps, turbine_radps))
    overrun_nm = -p.overrun_share * p.capacity_nms2 * turbine_radps**2
    faster_radps = ca.fmax(engine_radps, ca.fabs(turbine_radps))
    coupling_nm = p.coupling_nms2 * faster_radps * (engine_radps - turbine_radps)
    return _clip(coupling_nm, overrun_nm, capacity_nms2 * engine_radps**2)


def friction_nm(p: Engine, engine_radps: SX) -> SX:
    """Torque that the engine takes without fuel."""
    return (p.friction_nm + p.friction_nms * engine_radps) * _clip(engine_radps / _DRY_FRICTION_RADPS, -1.0, 1.0)


def full_load_nm(p: Engine, engine_radps: SX) -> SX:
    """Greatest torque at the flywheel, linear between the points of the table."""
    torque_nm = p.full_load_nm[0]
    for i in range(len(p.full_load_nm) - 1):
        width_radps = p.full_load_radps[i + 1] - p.full_load_radps[i]
        slope_nms = (p.full_load_nm[i + 1] - p.full_load_nm[i]) / width_radps
        torque_nm = torque_nm + slope_nms * _clip(engine_radps - p.full_load_radps[i], 0.0, width_radps)
    return torque_nm


def flywheel_nm(p: Engine, engine_radps: SX, gas_nm: SX) -> SX:
    """Torque at the flywheel: what burns, the governor's reserve and the starter, less friction."""
    support_nm = _clip(p.idle_damping_nms * (p.idle_radps - engine_radps), 0.0, p.idle_reserve_nm)
    fires = _clip((engine_radps - p.stall_radps) / (p.fire_radps - p.stall_radps), 0.0, 1.0)
    fuel = _clip((p.rev_limit_radps + p.rev_fade_radps - engine_radps) / p.rev_fade_radps, 0.0, 1.0)
    cranks = _clip((p.stall_radps + 2.0 * _CRANKING_RADPS - engine_radps) / _CRANKING_RADPS, 0.0, 1.0)
    return fires * fuel * (gas_nm + support_nm) + cranks * p.starter_nm - friction_nm(p, engine_radps)


def full_force_n(p: PowertrainParameters, speed_mps: SX) -> SX:
    """Wheel force that full pedal asks for; what the engine has in the gear is another matter."""
    return ca.fmin(p.pedal.full_force_n, p.pedal.full_power_w / ca.fmax(ca.fabs(speed_mps), _LEAST_MPS))


def _full_pedal_nm(p: PowertrainParameters, at: Shafts) -> SX:
    """Pump torque of the full wheel force."""
    amplification = torque_ratio(p.converter, speed_ratio(at.engine_radps, at.turbine_radps))
    gain = p.driveline.efficiency * ca.fmax(ca.fabs(at.ratio), _LEAST_RATIO) * amplification
    return full_force_n(p, at.wheels_radps * p.pedal.wheel_radius_m) * p.pedal.wheel_radius_m / gain


def _traction(p: PowertrainParameters, at: Shafts, vx_mps: SX) -> SX:
    """What traction control leaves of the pedal."""
    overspeed_mps = ca.fabs(at.wheels_radps) * p.pedal.wheel_radius_m - ca.fabs(vx_mps)
    return 1.0 - at.clutch_norm * _clip((overspeed_mps - p.pedal.traction_mps) / p.pedal.traction_fade_mps, 0.0, 1.0)


def _overrun_nm(p: PowertrainParameters, at: Shafts) -> SX:
    """Pump torque at zero pedal: from creep to an engine without fuel as the turbine, or in neutral the engine, gets faster."""
    begin_radps = _CREEP_END * p.engine.idle_radps
    speed_radps = at.engine_radps + at.clutch_norm * (at.turbine_radps - at.engine_radps)
    fade = _clip((speed_radps - begin_radps) / (p.pedal.overrun_radps - begin_radps), 0.0, 1.0)
    return (1.0 - fade) * at.clutch_norm * p.pedal.creep_nm - fade * friction_nm(p.engine, at.engine_radps)


def _clip(x: SX, low: SX, high: SX) -> SX:
    return ca.fmin(ca.fmax(x, low), high)
