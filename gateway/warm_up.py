"""What the control thread does shall not happen there for the first time: it runs a gateway first that is connected to nothing."""

from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from gateway.core import TICK_NS
from gateway.messages import HORIZON_STEPS, KEY_BYTES, CommandStatus, ControlCommand, Datagram, Operation, OperatorRequest, pack, unpack
from gateway.preparation import Preparation
from gateway.samples import GatewaySampler

WARM_UP_TICKS = 300
"""Three seconds: every cyclic message has come several times, and has been missed."""
_HEARD_TICKS = 200
_BOOT_ID = 1
_KEY = bytes(KEY_BYTES)


def warm_up(preparation: Preparation) -> int:
    """Let a throw-away gateway hear every message of the catalogue, commands and requests, and then nothing more.

    Returns:
        Frames that it would have sent.
    """
    core, sampler = preparation.new_core(_BOOT_ID), GatewaySampler()
    car = _Bus(preparation)
    sent = 0
    for tick in range(WARM_UP_TICKS):
        now_ns = (tick + 1) * TICK_NS
        command, request = _wired(_command(tick, now_ns)), _wired(_request(tick, now_ns))
        if not (isinstance(command, ControlCommand) and isinstance(request, OperatorRequest)):
            raise ValueError("a datagram does not survive its own wire form")
        output = core.step(now_ns, car.frames(now_ns) if tick < _HEARD_TICKS else [], command, request)
        sampler.sample(core, output, now_ns)
        _wired(output.state)
        sent += len(output.frames)
    return sent


class _Bus:
    """Every message of the catalogue at once, with neutral values."""

    def __init__(self, preparation: Preparation) -> None:
        catalogue = preparation.catalogue
        self._messages = [
            (spec.arbitration_id, catalogue.encode(spec.name, {}), E2EProtector(spec.e2e_data_id) if spec.e2e_data_id is not None else None)
            for spec in catalogue.by_name.values()
        ]

    def frames(self, now_ns: int) -> list[CanFrame]:
        """One frame of each."""
        return [
            CanFrame(arbitration_id, payload if protector is None else protector.protect(payload), now_ns)
            for arbitration_id, payload, protector in self._messages
        ]


def _wired(message: Datagram) -> Datagram | None:
    return unpack(pack(message, _KEY), _KEY)


def _command(tick: int, now_ns: int) -> ControlCommand:
    plan = (0.0,) * HORIZON_STEPS
    return ControlCommand(
        boot_id=_BOOT_ID, seq=tick, state_seq=tick, t_ns=now_ns, status=CommandStatus.OK, solve_time_ns=0,
        lateral_error_m=0.0, heading_error_rad=0.0, steer_rad=0.0, drive_norm=0.0, plan_steer_rad=plan, plan_drive_norm=plan,
    )  # fmt: skip


def _request(tick: int, now_ns: int) -> OperatorRequest:
    return OperatorRequest(_BOOT_ID, tick, list(Operation)[tick % len(Operation)], now_ns)
