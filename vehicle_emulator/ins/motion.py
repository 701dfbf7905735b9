"""Motion of a point of the car."""

from typing import NamedTuple

from vehicle_emulator.ins.axes import Vector, add, car_of, cross, level_of, turned
from vehicle_emulator.plants.interface import GRAVITY_MPS2, PlantState


class Motion(NamedTuple):
    """How a point of a rigid car moves; ISO 8855.

    Args:
        position_m, velocity_mps: east, north, up.
        roll_rad, pitch_rad, yaw_rad: right side down, nose down, counter-clockwise from east; yaw is not wrapped.
        rates_radps, angular_accelerations_radps2: about the car's axes.
        specific_force_mps2: what an accelerometer feels along the car's axes: (0, 0, 9.81) at rest on the level.
    """

    position_m: Vector
    velocity_mps: Vector
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rates_radps: Vector
    specific_force_mps2: Vector
    angular_accelerations_radps2: Vector = (0.0, 0.0, 0.0)

    def displaced(self, lever_m: Vector) -> "Motion":
        """Motion of the point that is `lever_m` away: forward, left, up."""
        rates_radps = self.rates_radps
        centripetal_mps2 = cross(rates_radps, cross(rates_radps, lever_m))
        tangential_mps2 = cross(self.angular_accelerations_radps2, lever_m)
        return self._replace(
            position_m=add(self.position_m, self.local_of(lever_m)),
            velocity_mps=add(self.velocity_mps, self.local_of(cross(rates_radps, lever_m))),
            specific_force_mps2=add(self.specific_force_mps2, add(tangential_mps2, centripetal_mps2)),
        )

    def local_of(self, car: Vector) -> Vector:
        """A vector given in the car's axes, east, north, up."""
        return turned(level_of(car, self.roll_rad, self.pitch_rad), self.yaw_rad)


def reference_point(state: PlantState, before: PlantState, period_s: float) -> Motion:
    """True motion of the reference point.

    Args:
        before: the state one period earlier, from which the angular accelerations follow.
    """
    roll_rad, pitch_rad, yaw_rad = state.roll_rad, state.pitch_rad, state.yaw_rad
    up = car_of((0.0, 0.0, GRAVITY_MPS2), roll_rad, pitch_rad)
    return Motion(
        position_m=(state.x_m, state.y_m, state.z_m),
        velocity_mps=turned(level_of((state.vx_mps, state.vy_mps, state.vz_mps), roll_rad, pitch_rad), yaw_rad),
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        yaw_rad=yaw_rad,
        rates_radps=(state.roll_rate_radps, state.pitch_rate_radps, state.yaw_rate_radps),
        specific_force_mps2=(state.ax_mps2 + up[0], state.ay_mps2 + up[1], state.az_mps2 + up[2]),
        angular_accelerations_radps2=(
            (state.roll_rate_radps - before.roll_rate_radps) / period_s,
            (state.pitch_rate_radps - before.pitch_rate_radps) / period_s,
            (state.yaw_rate_radps - before.yaw_rate_radps) / period_s,
        ),
    )
