"""A kinematic car as an FMU of FMI 2.0, made by pythonfmu; angles in degrees, y and yaw to the right."""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real

OUTPUTS = ("x", "y_right", "yaw_right_deg", "vx", "vy", "yaw_rate", "ax", "ay")


class Car(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.steer_deg = self.gas_percent = self.x_0 = self.speed_0 = 0.0
        self.x = self.y_right = self.yaw_right_deg = self.vx = self.vy = self.yaw_rate = self.ax = self.ay = 0.0
        self.lights = 0
        for name in ("steer_deg", "gas_percent"):
            self.register_variable(Real(name, causality=Fmi2Causality.input, start=0.0))
        for name in ("x_0", "speed_0"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed, start=0.0))
        for name in OUTPUTS:
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        self.register_variable(Integer("lights", causality=Fmi2Causality.input, variability=Fmi2Variability.discrete, start=0))

    def exit_initialization_mode(self):
        self.x, self.vx = self.x_0, self.speed_0

    def do_step(self, current_time, step_size):
        self.ax = 0.05 * self.gas_percent
        self.vx += step_size * self.ax
        self.yaw_rate = self.vx * math.tan(math.radians(self.steer_deg)) / 2.5
        yaw = -math.radians(self.yaw_right_deg) + step_size * self.yaw_rate
        self.yaw_right_deg = -math.degrees(yaw)
        self.x += step_size * self.vx * math.cos(yaw)
        self.y_right -= step_size * self.vx * math.sin(yaw)
        self.ay = self.vx * self.yaw_rate
        return current_time < 5.0
