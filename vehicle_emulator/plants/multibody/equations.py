"""The car as one ordinary differential equation x' = f(x, u, p), put together from its parts."""

from typing import NamedTuple

import casadi as ca

from vehicle_emulator.plants.interface import GRAVITY_MPS2
from vehicle_emulator.plants.multibody import brake, chassis, powertrain, steering, tyre
from vehicle_emulator.plants.multibody.brake import WHEEL_BRISTLE
from vehicle_emulator.plants.multibody.chassis import LEFT_RIGHT, axles
from vehicle_emulator.plants.multibody.layout import INPUTS, STATE, SX, Felt, Inputs, Motion, State
from vehicle_emulator.plants.multibody.parameters import CarParameters
from vehicle_emulator.plants.multibody.steering import COLUMN_BRISTLE
from vehicle_emulator.plants.multibody.symbols import parameter_symbols, symbols

AIR_DENSITY_KGPM3 = 1.2
_FORWARD, _LEFT, _UP = ca.DM([1.0, 0.0, 0.0]), ca.DM([0.0, 1.0, 0.0]), ca.DM([0.0, 0.0, 1.0])


class Functions(NamedTuple):
    """CasADi functions: `derivatives` (state, inputs, parameters) -> (x', felt), `motion` (state, parameters) -> motion."""

    derivatives: SX
    motion: SX


def build_functions(car: CarParameters) -> Functions:
    """The car's functions; of the numbers of `car` only their places are used."""
    (state, x), (inputs, u), (parameters, p) = symbols(STATE), symbols(INPUTS), parameter_symbols(car)
    rates, felt = derivatives(parameters, state, inputs)
    return Functions(
        ca.Function("derivatives", [x, u, p], ca.cse([ca.vertcat(*rates), ca.vertcat(*felt)]), ["x", "u", "p"], ["rate", "felt"]),
        ca.Function("motion", [x, p], ca.cse([ca.vertcat(*motion(parameters, state))]), ["x", "p"], ["motion"]),
    )


def derivatives(p: CarParameters, x: State, u: Inputs) -> tuple[State, Felt]:
    """x' and what is felt in the car."""
    return _Moment(p, x, u).derivatives()


def motion(p: CarParameters, x: State) -> Motion:
    """What follows from the state alone."""
    at, attitude = chassis.design(p.multibody), chassis.rotation(x.attitude)
    hubs_m = [x.position_m + attitude @ chassis.hub_m(at, x, i) for i in range(4)]
    roll_rad, yaw_rad = ca.atan2(attitude[2, 1], attitude[2, 2]), ca.atan2(attitude[1, 0], attitude[0, 0])
    pitch_rad = -ca.asin(ca.fmin(ca.fmax(attitude[2, 0], -1.0), 1.0))
    return Motion(
        x.position_m + attitude @ at.reference_m - at.height_m * _UP,
        ca.vertcat(roll_rad, pitch_rad, yaw_rad),
        x.velocity_mps + ca.cross(x.rates_radps, at.reference_m),
        x.rates_radps,
        x.steering_rad,
        x.steering_radps,
        ca.vertcat(*(x.spin_radps[i] - ca.dot(x.rates_radps, _axle(p, x, i)[0]) for i in range(4))),
        x.engine_radps,
        ca.vertcat(*(hub_m[0] for hub_m in hubs_m)),
        ca.vertcat(*(hub_m[1] for hub_m in hubs_m)),
    )


def _axle(p: CarParameters, x: State, i: int) -> tuple[SX, SX]:
    """Direction of the axis of a wheel, and its road-wheel angle per angle on the centre line."""
    if i >= 2:
        return _LEFT, 0.0
    masses, front = p.multibody.masses, p.multibody.front
    wheelbase_m = masses.cog_to_front_m + masses.cog_to_rear_m
    ackermann = p.multibody.steering.ackermann_share * LEFT_RIGHT[i] * 0.5 * front.track_m / wheelbase_m
    cosine, sine, gain = steering.wheel_direction(x.steering_rad / p.steering_ratio, ackermann)
    return ca.vertcat(-sine, cosine, 0.0), gain


class _Wheel(NamedTuple):
    """One wheel at one moment, in the body frame.

    Args:
        hub_m: r_i.
        axle, steer_gain: see `_axle`.
        spin_radps: as the car sees it.
        brake_nm, rolling_nm: friction against the spin.
    """

    hub_m: SX
    axle: SX
    steer_gain: SX
    contact: tyre.Contact
    forces: tyre.Forces
    spin_radps: SX
    bristle_rate: SX
    brake_nm: SX
    rolling_nm: SX


class _Moment:
    """The car at one moment."""

    def __init__(self, p: CarParameters, x: State, u: Inputs) -> None:
        self.p, self.x, self.u = p, x, u
        self.axles = axles(p.multibody)
        self.design = chassis.design(p.multibody)
        self.attitude = chassis.rotation(x.attitude)
        front = p.multibody.front_drive_share
        self.driven_shares = (0.5 * front,) * 2 + (0.5 * (1.0 - front),) * 2
        self.wheels = [self._wheel(i) for i in range(4)]

    def derivatives(self) -> tuple[State, Felt]:
        """See the function of the same name."""
        p, x, u = self.p, self.x, self.u
        engine_radps2, engine_nmps, axle_nm = self._engine()
        spin_rates = [self._spin_rate(i, share * u.drive_share * axle_nm) for i, share in enumerate(self.driven_shares)]
        hubs_m = [wheel.hub_m for wheel in self.wheels]
        body, travel = chassis.accelerations(p.multibody, self.design, x, hubs_m, self._drives(spin_rates))
        free = 1.0 - u.lift
        body *= free
        robot_nm, steering_radps, steering_radps2, column_rate, resistance_rate = self._column()
        slip_rates = [self._slip_rates(i) for i in range(4)]
        rates = State(
            self.attitude @ x.velocity_mps,
            chassis.attitude_rate(x.attitude, x.rates_radps),
            body[:3],
            body[3:],
            x.travel_mps,
            ca.vertcat(*(own + ca.dot(coupling, body) for own, coupling in travel)),
            ca.vertcat(*spin_rates),
            steering_radps,
            steering_radps2,
            column_rate,
            resistance_rate,
            free * ca.vertcat(*(rate for rate, _ in slip_rates)),
            free * ca.vertcat(*(rate for _, rate in slip_rates)),
            ca.vertcat(*(wheel.bristle_rate for wheel in self.wheels)),
            brake.pressure_rate(p.multibody.brakes, u.brake, x.brake_bar),
            engine_radps2,
            engine_nmps,
        )
        lever_m = self.design.reference_m
        reference_mps = x.velocity_mps + ca.cross(x.rates_radps, lever_m)
        acceleration = body[:3] + ca.cross(body[3:], lever_m) + ca.cross(x.rates_radps, reference_mps)
        return rates, Felt(acceleration, ca.vertcat(*(wheel.contact.load_n for wheel in self.wheels)), robot_nm)

    def _wheel(self, i: int) -> _Wheel:
        p, x = self.p, self.x
        hub_m = chassis.hub_m(self.design, x, i)
        axle, steer_gain = _axle(p, x, i)
        contact = self._contact(i, hub_m, axle)
        forces = tyre.forces(p.multibody.tyre, contact, self.u.road[4 * i + 3], x.slip_x[i], x.slip_y[i])
        spin_radps = x.spin_radps[i] - ca.dot(x.rates_radps, axle)
        bristle_rate = WHEEL_BRISTLE.rate(spin_radps, x.brake_bristle[i])
        share = WHEEL_BRISTLE.share(x.brake_bristle[i], bristle_rate)
        brake_nm = share * self._brake_limit_nm(i, contact)
        rolling_nm = share * p.multibody.tyre.rolling_resistance * contact.load_n * p.multibody.tyre.radius_m
        return _Wheel(hub_m, axle, steer_gain, contact, forces, spin_radps, bristle_rate, brake_nm, rolling_nm)

    def _contact(self, i: int, hub_m: SX, axle: SX) -> tyre.Contact:
        x = self.x
        height_m, slope_x, slope_y, _ = ca.vertsplit(self.u.road[4 * i : 4 * i + 4])
        steepness = ca.sqrt(1.0 + slope_x**2 + slope_y**2)
        place_m = x.position_m + self.attitude @ hub_m
        return tyre.contact(
            self.p.multibody.tyre,
            axle=axle,
            normal=self.attitude.T @ (ca.vertcat(-slope_x, -slope_y, 1.0) / steepness),
            height_m=(place_m[2] - height_m - slope_x * place_m[0] - slope_y * place_m[1]) / steepness,
            hub_mps=x.velocity_mps + ca.cross(x.rates_radps, hub_m) + x.travel_mps[i] * self.design.axes[i],
            rates_radps=x.rates_radps,
            spin_radps=x.spin_radps[i],
            load_share=1.0 - self.u.lift,
        )

    def _brake_limit_nm(self, i: int, contact: tyre.Contact) -> SX:
        """Largest torque of the brake, and of the locked gearbox where it acts."""
        brakes = self.p.multibody.brakes
        nm_per_bar = brakes.front_nm_per_bar if i < 2 else brakes.rear_nm_per_bar
        kept = brake.pressure_share(brakes, contact.rolling_mps, self.x.slip_x[i])
        park_nm = self.u.park * 2.0 * self.driven_shares[i] * brakes.park_lock_nm
        return self.u.brake_share * kept * nm_per_bar * self.x.brake_bar + park_nm

    def _engine(self) -> tuple[SX, SX, SX]:
        """Derivatives of the engine's states and the torque on the driven axle, or on both; all differentials are open."""
        x, u = self.x, self.u
        driven_radps = sum(share * wheel.spin_radps for share, wheel in zip(self.driven_shares, self.wheels, strict=True))
        return powertrain.derivatives(
            self.p.powertrain, x.engine_radps, x.engine_nm, u.accelerator, u.ratio, u.clutch, u.lockup, driven_radps, x.velocity_mps[0]
        )

    def _spin_rate(self, i: int, drive_nm: SX) -> SX:
        """I_w W' = T_drive - T_brake - T_rolling - T_bearing - F_x r."""
        wheel, axle = self.wheels[i], self.axles[i]
        drag_nm = wheel.brake_nm + wheel.rolling_nm + axle.bearing_nms * wheel.spin_radps + wheel.forces.x_n * wheel.contact.radius_m
        return (drive_nm - drag_nm) / axle.wheel_inertia_kgm2

    def _drives(self, spin_rates: list[SX]) -> chassis.Drives:
        """Forces and moments on the car."""
        p, x, u, at = self.p.multibody, self.x, self.u, self.design
        struts_n = chassis.struts_n(p, at, x)
        air_n = 0.5 * AIR_DENSITY_KGPM3 * p.drag_area_m2 * x.velocity_mps[0] * ca.fabs(x.velocity_mps[0])
        force_n = u.push_n * _LEFT - air_n * _FORWARD
        moment_nm = ca.cross(at.reference_m, force_n)
        wheels_n = []
        for i, (wheel, axle) in enumerate(zip(self.wheels, self.axles, strict=True)):
            contact, forces = wheel.contact, wheel.forces
            road_n = forces.x_n * contact.forward + forces.y_n * contact.left + contact.load_n * contact.normal
            force_n += road_n
            moment_nm += ca.cross(wheel.hub_m - contact.radius_m * contact.normal, road_n)
            moment_nm += forces.aligning_nm * contact.normal - wheel.rolling_nm * contact.left
            steer_radps = wheel.steer_gain * x.steering_radps / self.p.steering_ratio
            turning = x.spin_radps[i] * ca.cross(x.rates_radps + steer_radps * _UP, wheel.axle)
            moment_nm -= axle.wheel_inertia_kgm2 * (spin_rates[i] * wheel.axle + turning)
            # The brake turns its carrier, and the carrier turns as it travels by the difference of the two slopes.
            carrier_n = wheel.brake_nm * (axle.hub_slope - axle.braking_slope) / contact.radius_m
            wheels_n.append(ca.dot(at.axes[i], road_n) - struts_n[i] + carrier_n)
        return chassis.Drives(wheels_n, force_n, moment_nm, -GRAVITY_MPS2 * self.attitude.T @ _UP)

    def _column(self) -> tuple[SX, SX, SX, SX, SX]:
        """Torque of the steering robot, and the derivatives of angle, rate, bristle and believed resistance of the steering wheel."""
        p, x, u = self.p, self.x, self.u
        column, road_nm, gyroscopic_nm = p.multibody.steering, 0.0, 0.0
        for i, wheel in enumerate(self.wheels[:2]):
            road_nm += wheel.steer_gain * (wheel.forces.aligning_nm - column.mechanical_trail_m * wheel.forces.y_n)
            momentum = p.multibody.front.wheel_inertia_kgm2 * x.spin_radps[i]
            gyroscopic_nm += wheel.steer_gain * momentum * ca.dot(x.rates_radps, ca.cross(_UP, wheel.axle))
        robot_nm = steering.robot_nm(
            column,
            bandwidth_hz=p.servo_bandwidth_hz,
            damping_ratio=p.servo_damping_ratio,
            error_rad=u.demand_rad - x.steering_rad,
            rate_radps=x.steering_radps,
            resistance_nm=x.resistance_nm,
            limit_nm=u.torque_limit_nm,
        )
        bristle_rate = COLUMN_BRISTLE.rate(x.steering_radps, x.column_bristle)
        friction_nm = column.friction_nm * COLUMN_BRISTLE.share(x.column_bristle, bristle_rate)
        stop_nm = steering.stop_nm(column, x.steering_rad, p.road_wheel_limit_rad * p.steering_ratio)
        back_nm = ((1.0 - column.assist_share) * road_nm + gyroscopic_nm) / p.steering_ratio
        others_nm = u.driver_nm - friction_nm - stop_nm + back_nm
        resistance_rate = steering.resistance_rate(p.servo_resistance_hz, others_nm, x.resistance_nm)
        return robot_nm, x.steering_radps, (robot_nm + others_nm) / column.inertia_kgm2, bristle_rate, resistance_rate

    def _slip_rates(self, i: int) -> tuple[SX, SX]:
        """With the small angles by which suspension and steering give way, which change the slip and nothing else."""
        x, axle, wheel = self.x, self.axles[i], self.wheels[i]
        toe_rad = LEFT_RIGHT[i] * axle.toe_per_travel_radpm * x.travel_m[i] - axle.toe_per_force_radpn * wheel.forces.y_n
        return tyre.slip_rates(self.p.multibody.tyre, wheel.contact, x.slip_x[i], x.slip_y[i], toe_rad)
