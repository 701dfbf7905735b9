"""What the tests against the kernel need: interfaces of their own. In the guest everything is there, and what is missing is a failure."""

import os
import subprocess
from collections.abc import Callable

import pytest

from tests.support.slcan_adapter import SlcanAdapter


def cannot(reason: str) -> None:
    """Say why a test cannot run here; in the guest that is a failure."""
    if os.environ.get("XILGATE_VCAN_GUEST"):
        pytest.fail(reason)
    pytest.skip(f"{reason}: run `tests/support/vcan_guest.sh python -m pytest`")


def ip(*arguments: str) -> None:
    """Change interfaces."""
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def interface():
    """An interface that is the test's alone, down or up or removed as it likes."""
    try:
        ip("link", "add", "xilvcan", "type", "vcan")
    except (OSError, subprocess.CalledProcessError) as error:
        cannot(f"no interface can be made here: {getattr(error, 'stderr', error)}")
    ip("link", "set", "xilvcan", "up")
    yield "xilvcan"
    subprocess.run(["ip", "link", "delete", "xilvcan"], check=False, capture_output=True)


@pytest.fixture
def plug_in() -> Callable[[], SlcanAdapter]:
    """Plugs a simulated adapter in; all of them are gone at the end."""
    adapters: list[SlcanAdapter] = []

    def plug() -> SlcanAdapter:
        try:
            adapters.append(SlcanAdapter())
        except (OSError, subprocess.CalledProcessError) as error:
            cannot(f"the kernel's slcan driver takes no adapter here: {error}")
        return adapters[-1]

    yield plug
    for adapter in adapters:
        adapter.unplug()


@pytest.fixture
def adapter(plug_in) -> SlcanAdapter:
    return plug_in()
