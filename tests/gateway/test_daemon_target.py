"""What is installed on the target: the unit confines the gateway and gives it what it needs, the other files fit together."""

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from dbc.realtime import CONTROLLER_PRIORITY, GATEWAY_PRIORITY
from gateway.rig import Daemon, read_rig
from xil.cli_common import EXIT_USER

ROOT = Path(__file__).parents[2]
TARGET = ROOT / "gateway" / "target"
UNIT = TARGET / "xilgate-gateway.service"
CONTROLLER = TARGET / "xilgate-controller.service"
UNITS = pytest.mark.parametrize("unit", [UNIT, CONTROLLER], ids=lambda path: path.stem)
MAX_EXPOSURE = 21
"""Of `systemd-analyze security`, in tenths; the scale ends at 100."""
has_systemd = shutil.which("systemd-analyze") is not None


def entries(path):
    """All values of every key of a unit, by section and key."""
    found = {}
    section = ""
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault((section, key), []).append(value)
    return found


def service(unit):
    return {key: values for (section, key), values in entries(unit).items() if section == "Service"}


SERVICE = service(UNIT)


def test_it_is_watched_and_started_again_unless_its_file_is_wrong():
    assert SERVICE["Type"] == ["notify"]
    assert SERVICE["WatchdogSec"] == ["1"]
    assert SERVICE["Restart"] == ["on-failure"]
    assert SERVICE["RestartPreventExitStatus"] == [str(EXIT_USER)]


def test_a_reload_checks_the_file_before_it_asks_the_process():
    check, ask = SERVICE["ExecReload"]
    assert check == SERVICE["ExecStart"][0] + " --check"
    assert ask == "/bin/kill -HUP $MAINPID"


def test_systemd_waits_for_the_longest_stop_of_the_car():
    with pytest.raises(ValueError, match="1 to 60"):
        Daemon(stop_within_s=60.1)
    assert int(SERVICE["TimeoutStopSec"][0]) > 60


def test_real_time_by_limits_and_one_capability_for_the_bus():
    assert SERVICE["LimitRTPRIO"] == [str(GATEWAY_PRIORITY)]
    assert SERVICE["LimitMEMLOCK"] == ["infinity"]
    assert SERVICE["CapabilityBoundingSet"] == SERVICE["AmbientCapabilities"] == ["CAP_NET_ADMIN"]
    assert "RestrictRealtime" not in SERVICE


@pytest.mark.req("S1")
@UNITS
def test_it_is_confined(unit):
    found = service(unit)
    for key in (
        *("NoNewPrivileges", "PrivateTmp", "PrivateDevices", "ProtectClock", "ProtectControlGroups", "ProtectHome", "ProtectHostname"),
        *("ProtectKernelLogs", "ProtectKernelModules", "ProtectKernelTunables", "RestrictNamespaces", "RestrictSUIDSGID"),
        *("LockPersonality", "MemoryDenyWriteExecute"),
    ):
        assert found[key] == ["yes"], key
    assert found["ProtectSystem"] == ["strict"]
    assert found["User"] == ["xilgate"]
    assert (found["IPAddressDeny"], found["IPAddressAllow"]) == (["any"], ["localhost"])
    assert "ProcSubset" not in found  # it would hide the boot id, to which the key is bound


def test_only_the_gateway_has_the_bus():
    assert set(SERVICE["RestrictAddressFamilies"][0].split()) == {"AF_UNIX", "AF_CAN", "AF_INET", "AF_NETLINK"}
    controller = service(CONTROLLER)
    assert set(controller["RestrictAddressFamilies"][0].split()) == {"AF_UNIX", "AF_INET"}
    assert controller["CapabilityBoundingSet"] == [""]
    assert int(controller["LimitRTPRIO"][0]) == CONTROLLER_PRIORITY


@pytest.mark.skipif(not has_systemd, reason="no systemd-analyze")
@UNITS
def test_systemd_reads_the_unit_without_a_word(unit, tmp_path):
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace("/opt/xilgate/bin/xilgate", "/bin/true"))
    finished = subprocess.run(["systemd-analyze", "verify", "--man=no", str(copy)], capture_output=True, text=True, timeout=60, check=False)
    assert (finished.returncode, finished.stdout + finished.stderr) == (0, "")


@pytest.mark.skipif(not has_systemd, reason="no systemd-analyze")
@UNITS
def test_exposure_stays_low(unit):
    command = ["systemd-analyze", "security", "--no-pager", "--offline=true", f"--threshold={MAX_EXPOSURE}", str(unit)]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert finished.returncode == 0, finished.stdout.splitlines()[-1]


def test_example_lies_where_the_unit_and_the_other_files_say():
    example = read_rig(TARGET / "rig.toml")
    runtime, state = SERVICE["RuntimeDirectory"][0], SERVICE["StateDirectory"][0]
    assert example.control.directory == Path("/run") / runtime
    assert example.recorder.directory == Path("/var/lib") / state / "records"
    tmpfiles = (TARGET / "xilgate.tmpfiles.conf").read_text()
    assert f"d {example.recorder.directory} 0750 xilgate xilgate" in tmpfiles
    assert "z /etc/xilgate/rig.key 0640 root xilgate" in tmpfiles
    assert f"d {example.control.directory} 0750 xilgate xilgate" in tmpfiles  # `--check` looks for it before any unit has run
    assert example.realtime.priority <= int(SERVICE["LimitRTPRIO"][0])
    assert str(example.metrics.port) in (ROOT / "docs" / "target.md").read_text()


def test_the_bus_comes_up_with_the_bit_rate_of_the_dbc_and_no_restart_of_its_own():
    network = configparser.ConfigParser()
    network.optionxform = str
    network.read(TARGET / "80-xilgate-can0.network")
    assert network["CAN"]["BitRate"] == "500K"
    assert "RestartSec" not in network["CAN"]


def test_make_installs_every_file():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    recipe = re.search(r"^install-target:\n((?:\t.*\n)+)", makefile, re.M).group(1)
    for path in TARGET.iterdir():
        assert f"gateway/target/{path.name}" in recipe, path.name
    assert "--require-hashes" in recipe
