"""The part of the vehicle file that describes what drives the emulated car: engine, converter, gearbox, and what the pedal asks for.

"Pump" is the engine's side of the torque converter, "turbine" the gearbox's. All tables are flat lists.
"""

from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from dbc.section import NotNegative, Positive, Section, Share, misfit

Curve = Annotated[tuple[Positive, ...], Field(strict=False, min_length=8, max_length=8)]
PerGear = Annotated[tuple[Positive, ...], Field(strict=False, min_length=2, max_length=10)]
PerShift = Annotated[tuple[Positive, ...], Field(strict=False, min_length=1, max_length=9)]


class Engine(Section):
    """Engine with its idle governor, rev limiter and starter.

    Args:
        inertia_kgm2: of all that turns with the pump.
        lag_s: from the torque that is asked for to the torque of the gas, as a first order.
        full_load_radps, full_load_nm: greatest torque at the flywheel, eight points; constant below the first and above the last.
        friction_nm, friction_nms: torque that an engine without fuel takes, at standstill and its growth with speed.
        idle_radps: speed that the governor holds.
        idle_stiffness_nms: torque that the governor adds per speed missing, through the lag of the gas.
        idle_damping_nms, idle_reserve_nm: the same without lag (ignition or rail pressure in reserve), and its limit.
        stall_radps, fire_radps: combustion is none below the first speed and whole above the second.
        rev_limit_radps, rev_fade_radps: where fuel begins to be cut, and over what range it vanishes.
        starter_nm: torque of the starter, which cranks whenever combustion fails.
    """

    inertia_kgm2: Positive
    lag_s: Annotated[float, Field(ge=0.01)]
    full_load_radps: Curve
    full_load_nm: Curve
    friction_nm: NotNegative
    friction_nms: NotNegative
    idle_radps: Positive
    idle_stiffness_nms: NotNegative
    idle_damping_nms: NotNegative
    idle_reserve_nm: NotNegative
    stall_radps: Positive
    fire_radps: Positive
    rev_limit_radps: Positive
    rev_fade_radps: Positive
    starter_nm: Positive

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _increasing("full_load_radps", self.full_load_radps)
        _increasing("stall_radps, fire_radps, idle_radps, rev_limit_radps", _speeds(self))
        return self


class Converter(Section):
    """Torque converter with its lock-up clutch.

    Args:
        capacity_nms2: pump torque over squared pump speed, with the turbine at rest.
        capacity_fall: share of it that is lost until the turbine is as fast as the pump.
        stall_torque_ratio: turbine torque over pump torque, with the turbine at rest.
        coupling_speed_ratio: turbine speed over pump speed from which on both torques are equal.
        coupling_nms2: pump torque near equal speeds over the product of slip and the greater speed.
        overrun_share: capacity when the turbine drives the pump, over `capacity_nms2`.
        lockup_nm, lockup_slip_radps: greatest torque of the lock-up clutch, and the slip at which it has it.
    """

    capacity_nms2: Positive
    capacity_fall: Share
    stall_torque_ratio: Annotated[float, Field(ge=1.0, le=4.0)]
    coupling_speed_ratio: Annotated[float, Field(gt=0.0, lt=1.0)]
    coupling_nms2: Positive
    overrun_share: NotNegative
    lockup_nm: NotNegative
    lockup_slip_radps: Positive

    @model_validator(mode="after")
    def _only_dissipates(self) -> Self:
        # Torque ratio times speed ratio is greatest at the coupling point or at the top of its parabola before it.
        gain, coupling = self.stall_torque_ratio - 1.0, self.coupling_speed_ratio
        top = min(coupling, 0.5 * self.stall_torque_ratio * coupling / gain) if gain else coupling
        if (self.stall_torque_ratio - gain * top / coupling) * top > 1.0:
            raise misfit("coupling_speed_ratio so low that the turbine gives no more power than the pump takes")
        return self


class Driveline(Section):
    """From the turbine to the driven wheels.

    Args:
        efficiency: power out over power in of gearbox and final drive.
        drag_nm, drag_nms: torque at the axle that it takes without load, and its growth with the speed of the wheels.
    """

    efficiency: Annotated[float, Field(gt=0.0, le=1.0)]
    drag_nm: NotNegative
    drag_nms: NotNegative


class Pedal(Section):
    """What the engine controller makes of the accelerator.

    Args:
        full_force_n, full_power_w: at the wheels, at full pedal; the smaller of the two that they allow.
        wheel_radius_m: by which the controller converts wheel speed and force.
        creep_nm: pump torque at zero pedal with the turbine at rest.
        overrun_radps: turbine speed from which on zero pedal is an engine without fuel.
        inertia_share: share of the torque for the acceleration of the engine itself that the controller adds.
        traction_mps, traction_fade_mps: driven wheels faster than the car by the first speed get less torque, by the sum of both none.
    """

    full_force_n: Positive
    full_power_w: Positive
    wheel_radius_m: Positive
    creep_nm: NotNegative
    overrun_radps: Positive
    inertia_share: Annotated[float, Field(ge=0.0, lt=1.0)]
    traction_mps: Positive
    traction_fade_mps: Positive


class Gearbox(Section):
    """Automatic gearbox and its controller.

    The shift speeds hold at no, a quarter, half and full pedal and are interpolated in between; entry i is for the shift between gear
    i + 1 and gear i + 2.

    Args:
        ratios, reverse_ratio, final_drive: reverse without its sign.
        shift_s, shift_clutch_norm: duration of a shift when the engine follows at once, and how far the clutch stays closed in the
            middle of an upshift.
        select_s: time to close or open the clutch when the lever moves.
        creep_clutch_norm: how far the clutch closes in a car that stands without pedal.
        creep_pedal_norm, creep_mps: pedal or speed from which on it closes wholly.
        dwell_s: least time between shifts of opposite directions.
        kickdown_norm: pedal from which on a downshift need not dwell.
        upshift_radps: engine speed that shifts up at any rate.
        lockup_gear: lowest gear with lock-up.
        lockup_close_radps, lockup_open_radps: turbine speeds at which the lock-up clutch closes and opens.
        lockup_close_s, lockup_open_s: time that it takes.
    """

    ratios: PerGear
    reverse_ratio: Positive
    final_drive: Positive
    shift_s: Positive
    shift_clutch_norm: Share
    select_s: Positive
    creep_clutch_norm: Share
    creep_pedal_norm: Positive
    creep_mps: Positive
    dwell_s: NotNegative
    kickdown_norm: Share
    upshift_radps: Positive
    lockup_gear: Annotated[float, Field(ge=1.0)]
    lockup_close_radps: Positive
    lockup_open_radps: Positive
    lockup_close_s: Positive
    lockup_open_s: Positive
    upshift_light_mps: PerShift
    upshift_quarter_mps: PerShift
    upshift_half_mps: PerShift
    upshift_full_mps: PerShift
    downshift_light_mps: PerShift
    downshift_quarter_mps: PerShift
    downshift_half_mps: PerShift
    downshift_full_mps: PerShift

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _increasing("ratios, last first", self.ratios[::-1])
        _increasing("lockup_open_radps, lockup_close_radps", (self.lockup_open_radps, self.lockup_close_radps))
        for column in ("light", "quarter", "half", "full"):
            ups, downs = getattr(self, f"upshift_{column}_mps"), getattr(self, f"downshift_{column}_mps")
            if not len(ups) == len(downs) == len(self.ratios) - 1:
                raise misfit(f"{len(self.ratios) - 1} entries, one per shift, in upshift_{column}_mps and downshift_{column}_mps")
            _increasing(f"upshift_{column}_mps", ups)
            _increasing(f"downshift_{column}_mps", downs)
            for down, up in zip(downs, ups, strict=True):
                _increasing(f"downshift_{column}_mps, upshift_{column}_mps", (down, up))
        return self


class PowertrainParameters(Section):
    """What drives the emulated car."""

    engine: Engine
    converter: Converter
    driveline: Driveline
    pedal: Pedal
    gearbox: Gearbox


def _speeds(engine: Engine) -> tuple[float, ...]:
    return engine.stall_radps, engine.fire_radps, engine.idle_radps, engine.rev_limit_radps


def _increasing(names: str, values: tuple[float, ...]) -> None:
    if any(left >= right for left, right in pairwise(values)):
        raise misfit(f"{names} increasing, not {', '.join(f'{value:g}' for value in values)}")
