"""The operator of a run, fed with states."""

from msgspec.structs import replace

from gateway.messages import Operation
from gateway.telemetry import StateSample
from xil.operator import ASK_PERIOD_S, PATIENCE_S, READY_TIMEOUT_S, Advice, Ending, Operator

STATE = StateSample(
    t_ns=0, seq=0, mode="STANDBY", is_valid=True, x_m=0.0, y_m=0.0, yaw_rad=0.0, vx_mps=0.0, vy_mps=0.0, yaw_rate_radps=0.0, ax_mps2=0.0,
    sr_angle_rad=0.0, ar_position_norm=0.0, br_position_norm=0.0, sr_command_rad=0.0, ar_command_norm=0.0, br_command_norm=0.0,
)


class Run:
    """Feeds an operator every 20 ms; the car drives at `vx_mps` along x."""

    def __init__(self, time_limit_s=60.0, end_m=50.0):
        self.operator = Operator(time_limit_s, lambda x_m, y_m: x_m > end_m)
        self.t_s = self.x_m = 0.0

    def go(self, duration_s, mode, vx_mps=0.0, is_valid=True):
        """The first advice that is not empty, or an empty one."""
        for _ in range(round(duration_s / 0.02)):
            self.t_s += 0.02
            self.x_m += 0.02 * vx_mps
            state = replace(STATE, t_ns=round(self.t_s * 1e9), mode=mode, vx_mps=vx_mps, x_m=self.x_m, is_valid=is_valid)
            if (advice := self.operator.advise(state)) != Advice():
                return advice
        return Advice()


def test_arms_then_engages_and_asks_again_until_it_is_granted():
    run = Run()
    assert run.go(0.1, "SILENT", 20.0) == Advice(Operation.ARM)
    assert run.go(ASK_PERIOD_S - 0.02, "SILENT", 20.0) == Advice()
    assert run.go(0.1, "STANDBY", 20.0) == Advice(Operation.ARM)
    assert run.go(0.02, "READY", 20.0) == Advice(Operation.ENGAGE)
    assert run.go(ASK_PERIOD_S - 0.02, "READY", 20.0) == Advice()
    assert run.go(0.1, "READY", 20.0) == Advice(Operation.ENGAGE)
    assert run.go(5.0, "ENGAGED", 20.0) == Advice()


def test_gives_up_when_never_ready():
    run = Run()
    advice = [run.go(0.02, "STANDBY") for _ in range(round((READY_TIMEOUT_S - 1.0) * 50))]
    assert {one.operation for one in advice} == {None, Operation.ARM}
    assert {one.ending for one in advice} == {None}
    assert Ending.NEVER_READY in [run.go(0.02, "STANDBY").ending for _ in range(100)]


def test_ends_when_the_car_stands_at_the_end():
    run = Run()
    run.go(0.1, "READY", 20.0)
    assert run.go(5.0, "ENGAGED", 20.0) == Advice()
    assert run.go(0.4, "ENGAGED", 0.0) == Advice()
    assert run.go(0.4, "ENGAGED", 0.0) == Advice(Operation.DISENGAGE, Ending.COMPLETED)


def test_before_the_end_the_car_may_stand_for_a_while_and_drive_on():
    run = Run()
    run.go(0.1, "READY", 5.0)
    assert run.go(2.0, "ENGAGED", 5.0) == Advice()
    assert run.go(PATIENCE_S - 0.5, "ENGAGED", 0.0) == Advice()
    assert run.go(1.0, "ENGAGED", 5.0) == Advice()
    assert run.go(PATIENCE_S - 0.5, "ENGAGED", 0.0) == Advice()
    assert run.go(1.0, "ENGAGED", 0.0) == Advice(Operation.DISENGAGE, Ending.COMPLETED)


def test_a_start_from_standstill_is_no_end():
    run = Run()
    run.go(0.1, "READY", 0.0)
    assert run.go(3.0, "ENGAGED", 0.0) == Advice()


def test_a_safe_stop_ends_the_run_at_standstill():
    run = Run()
    run.go(0.1, "READY", 20.0)
    run.go(1.0, "ENGAGED", 20.0)
    assert run.go(5.0, "SAFE_STOP", 10.0) == Advice()
    assert run.go(1.0, "SAFE_STOP", 0.0) == Advice(ending=Ending.STOPPED)


def test_an_engagement_too_short_to_be_seen_still_counts():
    run = Run()
    run.go(0.1, "READY", 20.0)
    assert run.go(0.1, "SAFE_STOP", 20.0) == Advice()
    assert run.operator.has_engaged
    assert run.go(1.0, "SAFE_STOP", 0.0) == Advice(ending=Ending.STOPPED)


def test_an_invalid_state_does_not_stand():
    run = Run(time_limit_s=10.0)
    run.go(0.1, "READY", 20.0)
    run.go(1.0, "ENGAGED", 20.0)
    assert run.go(5.0, "SAFE_STOP", 0.0, is_valid=False) == Advice()
    assert run.go(6.0, "SAFE_STOP", 0.0, is_valid=False) == Advice(ending=Ending.STOPPED)


def test_time_limit():
    run = Run(time_limit_s=10.0)
    run.go(0.1, "READY", 20.0)
    assert run.go(9.9, "ENGAGED", 20.0) == Advice()
    assert run.go(1.0, "ENGAGED", 20.0) == Advice(Operation.DISENGAGE, Ending.TIME_LIMIT)
