"""F12: a gateway that was killed is back soon, and silent."""

import pytest

from gateway.messages import Operation

pytestmark = pytest.mark.realtime

RESTART_S = 2.0


@pytest.mark.long
@pytest.mark.req("F12", "E4")
def test_a_gateway_that_was_killed_is_back_in_two_seconds_and_silent(bench, figure):
    begin = len(bench.starts_s)
    for _ in range(5):
        bench.restart_gateway()
        reply = bench.ask(Operation.ENGAGE)
        assert reply.mode.name == "SILENT"
        assert reply.refusals
    assert figure("from the start of the process to its first answer, quickest of 5", min(bench.starts_s[begin:]), "s", f"<= {RESTART_S:g}")
