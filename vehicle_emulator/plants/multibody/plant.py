"""The car of fifteen degrees of freedom behind the interface of all emulated cars."""

import math

from dbc.vehicle import Vehicle
from vehicle_emulator.plants.interface import Plant, PlantInputs, PlantState, Progress, Road, silent
from vehicle_emulator.plants.multibody.gearbox import Gearbox
from vehicle_emulator.plants.multibody.layout import INPUTS, MOTION, STATE, slices
from vehicle_emulator.plants.multibody.library import MOTIONS, CompiledCar, build
from vehicle_emulator.plants.multibody.parameters import car_parameters

_S, _U, _M = slices(STATE), slices(INPUTS), slices(MOTION)
_FELT, _LOADS, _ROBOT = slice(MOTIONS, MOTIONS + 3), slice(MOTIONS + 3, MOTIONS + 7), MOTIONS + 7
_STANDING_BRAKE = 0.5
"""Brake pedal with which a car stands at the start; its pressure is there until the pedals of the first step say otherwise."""
_STANDING_HANDS_NM = 100.0
"""Torque that holds the steering wheel straight until the first step; on a road that falls to the side the wheels would turn."""
_STILL = 1e-6
"""A car stands when nothing is faster than this [m/s, rad/s]."""
_SETTLING_STEP_S, _STEPS_PER_LOOK, _MOST_LOOKS = 0.001, 50, 200


class MultibodyPlant(Plant):
    """A car on its road, or with its wheels hanging from a lift.

    It starts settled: standing on its brakes, or rolling at a speed with gear, wheels and engine as fast as they then are.

    Args:
        vehicle: numbers of the car.
        road: what it stands on.
        pose: x [m], y [m] and yaw [rad] at the start.
        speed_mps: forward speed at the start.
        progress: told in one line each what takes time.
        is_lifted: body held where it would stand, wheels hanging; `speed_mps` is of no meaning then.

    Raises:
        BuildError: the car's library is not in the cache and cannot be built.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        road: Road,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
        speed_mps: float = 0.0,
        progress: Progress = silent,
        *,
        is_lifted: bool = False,
    ) -> None:
        self._vehicle, self._pose = vehicle, pose
        self._numbers = car_parameters(vehicle)
        self._road = road
        self._lift = float(is_lifted)
        self._car = CompiledCar(build(self._numbers, progress), self._numbers)
        self._gearbox = Gearbox(vehicle.powertrain.gearbox, vehicle.powertrain.pedal.wheel_radius_m)
        self._front_share = self._numbers.multibody.front_drive_share
        self._yaw_rad = pose[2]
        self._settle(pose)
        if speed_mps != 0.0 and not is_lifted:
            self._roll(speed_mps, pose)
        self._state = self._observed()

    @property
    def car(self) -> CompiledCar:
        """The compiled car, for those who measure it."""
        return self._car

    @property
    def state(self) -> PlantState:
        """The state reached by the last step."""
        return self._state

    def on_the_lift(self) -> "MultibodyPlant":
        """The same car at rest with its wheels in the air, where it started."""
        return MultibodyPlant(self._vehicle, self._road, self._pose, is_lifted=True)

    def impose_steering(self, angle_rad: float, rate_radps: float) -> None:
        """Set angle and rate of the steering wheel; the next step starts from them."""
        self._car.state[_S.steering_rad] = (angle_rad,)
        self._car.state[_S.steering_radps] = (rate_radps,)

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s` (1 ms) with the inputs held and return the state reached."""
        self._car.inputs[:] = self._held(dt_s, inputs)
        self._car.advance(dt_s)
        self._state = self._observed()
        return self._state

    def _held(self, dt_s: float, inputs: PlantInputs) -> tuple[float, ...]:
        """The inputs of the compiled car, in the order of `layout.Inputs`."""
        steering, faults, state = inputs.steering, inputs.faults, self._state
        gearbox = self._gearbox.step(
            dt_s, inputs.selector, inputs.accelerator_norm, self._driven_radps(state), state.engine_speed_radps
        )  # fmt: skip
        return (
            steering.demand_rad,
            steering.torque_limit_nm,
            steering.driver_torque_nm,
            inputs.accelerator_norm,
            inputs.brake_norm,
            gearbox.ratio,
            gearbox.clutch_norm,
            gearbox.lockup_norm,
            gearbox.is_park_locked,
            faults.drive_norm,
            faults.brake_norm,
            faults.push_n,
            self._lift,
            *self._planes(),
        )

    def _planes(self) -> list[float]:
        """The road under each wheel as `layout.Inputs` has it."""
        outputs, at = self._car.outputs, self._road.at
        planes: list[float] = []
        for x_m, y_m in zip(outputs[_M.hubs_x_m], outputs[_M.hubs_y_m], strict=True):
            z_m, slope_x, slope_y, friction = at(x_m, y_m)
            planes += (z_m - slope_x * x_m - slope_y * y_m, slope_x, slope_y, friction)
        return planes

    def _driven_radps(self, state: PlantState) -> float:
        front_left, front_right, rear_left, rear_right = state.wheel_speeds_radps
        return 0.5 * (self._front_share * (front_left + front_right) + (1.0 - self._front_share) * (rear_left + rear_right))

    def _observed(self) -> PlantState:
        y = self._car.outputs[:]
        self._yaw_rad += math.remainder(y[5] - self._yaw_rad, math.tau)
        y[5] = self._yaw_rad
        return PlantState._make(
            (*y[:12], *y[_FELT], *y[12:14], y[_ROBOT], tuple(y[14:18]), tuple(y[_LOADS]), y[18], self._gearbox.state.gear)
        )

    def _settle(self, pose: tuple[float, float, float]) -> None:
        """Stand or hang at rest at a pose."""
        (x_m, y_m, yaw_rad), car = pose, self._car
        car.state[_S.attitude] = _quaternion(*self._lie(pose), yaw_rad)
        car.state[_S.brake_bar] = (_STANDING_BRAKE * self._numbers.multibody.brakes.full_pedal_bar,)
        car.state[_S.engine_radps] = (self._numbers.powertrain.engine.idle_radps,)
        car.inputs[_U.brake], car.inputs[_U.brake_share], car.inputs[_U.lift] = (_STANDING_BRAKE,), (1.0,), (self._lift,)
        car.inputs[_U.torque_limit_nm] = (_STANDING_HANDS_NM,)
        self._put(x_m, y_m, self._road.at(x_m, y_m).z_m)
        for _ in range(_MOST_LOOKS):
            car.inputs[_U.road] = self._planes()
            car.advance(_SETTLING_STEP_S, _STEPS_PER_LOOK)
            if max(map(abs, (*car.state[_S.velocity_mps], *car.state[_S.rates_radps], *car.state[_S.travel_mps]))) < _STILL:
                break
        self._put(x_m, y_m, car.outputs[2])
        car.state[_S.velocity_mps] = car.state[_S.rates_radps] = (0.0, 0.0, 0.0)

    def _lie(self, pose: tuple[float, float, float]) -> tuple[float, float]:
        """Roll and pitch of a body that is parallel to the road."""
        x_m, y_m, yaw_rad = pose
        under, cosine, sine = self._road.at(x_m, y_m), math.cos(yaw_rad), math.sin(yaw_rad)
        pitch_rad = -math.atan(under.slope_x * cosine + under.slope_y * sine)
        return math.atan((under.slope_y * cosine - under.slope_x * sine) * math.cos(pitch_rad)), pitch_rad

    def _put(self, x_m: float, y_m: float, z_m: float) -> None:
        """Move the car, as it is, to a place."""
        car = self._car
        car.advance(0.0, 0)
        position_m = zip(car.state[_S.position_m], (x_m, y_m, z_m), car.outputs[_M.position_m], strict=True)
        car.state[_S.position_m] = tuple(old + wanted - now for old, wanted, now in position_m)
        car.advance(0.0, 0)

    def _roll(self, speed_mps: float, pose: tuple[float, float, float]) -> None:
        """Give a standing car a speed along the road; tyres free of force, brakes off."""
        car, tyre = self._car, self._numbers.multibody.tyre
        nose_down_rad = car.outputs[_M.angles_rad][1] - self._lie(pose)[1]
        car.state[_S.velocity_mps] = (speed_mps * math.cos(nose_down_rad), 0.0, speed_mps * math.sin(nose_down_rad))
        deflections_m = (load_n / tyre.stiffness_npm for load_n in car.outputs[_LOADS])
        spins_radps = [speed_mps / (tyre.radius_m - deflection_m / 3.0) for deflection_m in deflections_m]
        car.state[_S.spin_radps] = spins_radps
        car.state[_S.slip_x] = car.state[_S.slip_y] = (0.0,) * 4
        car.state[_S.brake_bristle] = (math.copysign(1.0, speed_mps),) * 4
        car.state[_S.brake_bar] = (0.0,)
        if speed_mps > 0.0:
            self._gearbox.start(self._gearbox.gear_at(speed_mps))
            turbine_radps = self._gearbox.state.ratio * sum(spins_radps) / 4.0
            car.state[_S.engine_radps] = (max(turbine_radps, self._numbers.powertrain.engine.idle_radps),)
        car.advance(0.0, 0)


def _quaternion(roll_rad: float, pitch_rad: float, yaw_rad: float) -> tuple[float, float, float, float]:
    """Of intrinsic z-y-x angles, scalar first."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(0.5 * angle), math.sin(0.5 * angle)) for angle in (roll_rad, pitch_rad, yaw_rad))
    return cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
