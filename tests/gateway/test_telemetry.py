"""Telemetry over real Zenoh sessions on loopback."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.errors import UserMistake
from dbc.section import read_section
from gateway import telemetry
from gateway.keys import KeyMistake
from gateway.telemetry import (
    MAX_REQUEST_BYTES,
    MAX_SAMPLE_BYTES,
    TOPICS,
    Publisher,
    Source,
    Subscriber,
    TelemetryError,
    TlsSection,
    WorldSample,
    ask,
    decode,
    port_of,
    topic_of,
)
from gateway.telemetry.security import connecting_options, listening_options
from tests.support.certificates import make_authority, make_certificate
from tests.support.processes import free_base_port, wait_until

WORLD = WorldSample(
    t_ns=1, seq=2, x_m=1.5, y_m=-2.5, yaw_rad=0.1, vx_mps=22.2, vy_mps=0.0, yaw_rate_radps=0.0, ax_mps2=0.0, ay_mps2=0.0, sr_angle_rad=0.2,
    ar_position_norm=0.1, br_position_norm=0.0, robots_engaged=True,
)


def test_what_is_too_much_is_dropped_and_counted_and_nobody_waits():
    gate = threading.Event()

    class Stuck:
        def put(self, _):
            gate.wait(10)

    with Publisher(Source.EMULATOR, free_base_port()) as publisher:
        publisher._publishers = {"world": Stuck()}
        publisher.post(WORLD)
        wait_until(lambda: not publisher._queue, 5, "the thread has taken the first sample")
        for _ in range(256 + 7):
            publisher.post(WORLD)
        assert publisher.dropped == 7
        gate.set()


def test_every_source_has_a_port_and_every_topic_a_type():
    assert len({port_of(source, 7000) for source in Source}) == len(Source)
    assert {source for source, _ in TOPICS.values()} == set(Source)
    assert topic_of(WORLD) == "world"


def test_sample_arrives_whole_whoever_starts_first():
    base = free_base_port()
    received = []
    with Subscriber(lambda topic, payload: received.append(decode(topic, payload)), ["world", "state"], base):
        time.sleep(0.2)  # the reader is there before the publisher
        with Publisher(Source.EMULATOR, base) as publisher:

            def has_arrived():
                publisher.post(WORLD)
                return bool(received)

            wait_until(has_arrived, 10, "a sample")
    assert received[0] == WORLD


def test_busy_port_is_one_line_that_names_it():
    base = free_base_port()
    with Publisher(Source.GATEWAY, base), pytest.raises(TelemetryError, match=str(base)) as caught:
        Publisher(Source.GATEWAY, base)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("payload", [b"", b"junk", b"{}", b'{"t_ns": "now"}', b"[1, 2]"])
def test_junk_is_no_sample(payload):
    assert decode("world", payload) is None
    assert decode("nowhere", payload) is None


def test_posting_never_blocks_and_loses_the_oldest():
    with Publisher(Source.EMULATOR, free_base_port()) as publisher:
        start_s = time.monotonic()
        for _ in range(20_000):
            publisher.post(WORLD)
        assert time.monotonic() - start_s < 5.0


def test_process_with_an_open_reader_exits():
    code = (
        "from gateway.telemetry import Subscriber\n"
        f"reader = Subscriber(lambda topic, payload: None, ['state'], {free_base_port()})\n"
        "raise SystemExit(7)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=30, check=False).returncode == 7


# What comes from outside

NESTED = [b"[" * depth for depth in (100, 10_000, 1_000_000)]
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)


@pytest.mark.req("S3", "F17")
@settings(max_examples=5_000, deadline=None)
@given(st.sampled_from([*TOPICS, "nowhere"]), st.binary(max_size=300))
def test_no_bytes_break_the_decoder(topic, payload):
    sample = decode(topic, payload)
    assert sample is None or type(sample) is TOPICS[topic][1]


@pytest.mark.req("S3", "F17")
@settings(max_examples=5_000, deadline=None)
@given(st.sampled_from(list(msgspec.structs.asdict(WORLD))), SCALARS | st.lists(SCALARS, max_size=3))
def test_no_value_breaks_the_decoder(name, value):
    payload = json.dumps(msgspec.structs.asdict(WORLD) | {name: value}).encode()
    sample = decode("world", payload)
    assert sample is None or type(sample) is WorldSample


@pytest.mark.req("S3", "F17")
@pytest.mark.parametrize("opening", NESTED, ids=len)
def test_nesting_and_size_are_bounded(opening):
    whole = msgspec.json.encode(WORLD)
    assert decode("world", opening) is None
    assert decode("world", b'{"extra": ' + opening + b"]" * len(opening) + b"," + whole[1:]) in (None, WORLD)
    assert decode("world", whole + b" " * (MAX_SAMPLE_BYTES - len(whole))) == WORLD
    assert decode("world", whole + b" " * (MAX_SAMPLE_BYTES - len(whole) + 1)) is None


FLOODER = """
import sys, time, zenoh, json
config = zenoh.Config()
for key, value in {"mode": "peer", "connect/endpoints": [f"tcp/127.0.0.1:{sys.argv[1]}"], "scouting/multicast/enabled": False}.items():
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
small, large, sent = b"j" * 100, b"j" * (1 << 20), 0
print("connected", flush=True)
end = time.monotonic() + 60
while time.monotonic() < end:
    for key in ("state", "world", "objects", "nowhere"):
        for _ in range(25):
            session.put("xilgate/" + key, small)
        session.put("xilgate/" + key, large)
    session.get("xilgate/emulator/service", payload=large, timeout=1.0)
    time.sleep(0.01)
"""


def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.req("F17")
def test_a_flood_on_our_keys_neither_fills_memory_nor_stops_the_samples():
    """Some 10,000 small messages and 400 MB a second as far as the machine can, from a stranger on loopback, for two seconds."""
    base, received, asked = free_base_port(), [], []
    with (
        Publisher(Source.EMULATOR, base) as publisher,
        Subscriber(lambda topic, payload: received.append(decode(topic, payload)), ["world"], base),
    ):
        publisher.serve("service", lambda payload: asked.append(payload) or b"{}")

        def has_arrived():
            publisher.post(WORLD)
            return bool(received)

        wait_until(has_arrived, 10, "a sample")
        flooder = subprocess.Popen([sys.executable, "-c", FLOODER, str(port_of(Source.EMULATOR, base))], stdout=subprocess.PIPE)
        try:
            assert flooder.stdout.readline() == b"connected\n"
            time.sleep(0.3)  # buffers that grow once have grown
            before_mb, seen = resident_mb(), len(received)
            longest_s, end_s = 0.0, time.monotonic() + 2.0
            while time.monotonic() < end_s:
                start_s = time.thread_time()
                publisher.post(WORLD)
                longest_s = max(longest_s, time.thread_time() - start_s)
                time.sleep(0.01)
            assert flooder.poll() is None
            assert resident_mb() - before_mb < 100.0
            assert longest_s < 0.01  # of the caller's CPU time
            wait_until(lambda: len(received) - seen > 50, 20, "samples during the flood")
        finally:
            flooder.kill()
            flooder.wait()
            flooder.stdout.close()
    assert all(sample == WORLD for sample in received)
    assert asked == []


@pytest.mark.req("S3")
def test_a_request_that_is_too_long_is_refused_unread():
    base, asked = free_base_port(), []
    with Publisher(Source.EMULATOR, base) as publisher:
        publisher.serve("service", lambda payload: asked.append(len(payload)) or b"{}")
        assert ask(Source.EMULATOR, "service", b"x" * MAX_REQUEST_BYTES, base) == b"{}"
        with pytest.raises(TelemetryError, match=f"at most {MAX_REQUEST_BYTES}"):
            ask(Source.EMULATOR, "service", b"x" * (MAX_REQUEST_BYTES + 1), base)
    assert asked == [MAX_REQUEST_BYTES]


@pytest.mark.req("S3")
def test_a_request_without_content_is_answered_as_any_other():
    base, asked = free_base_port(), []
    with Publisher(Source.EMULATOR, base) as publisher:
        publisher.serve("service", lambda payload: asked.append(payload) or b"answer")
        assert ask(Source.EMULATOR, "service", b"", base) == b"answer"
        with telemetry._session([], [f"tcp/127.0.0.1:{port_of(Source.EMULATOR, base)}"], within_s=5.0) as session:
            (reply,) = session.get("xilgate/emulator/service", timeout=10.0)
            assert reply.ok.payload.to_bytes() == b"answer"
    assert asked == [b"", b""]


# Who may connect


def own_sockets(*protocols):
    """Rows of the kernel's tables that belong to this process."""
    descriptors = [Path("/proc/self/fd") / name for name in os.listdir("/proc/self/fd")]
    own = {os.readlink(path) for path in descriptors if path.is_symlink()}
    rows = [line.split() for name in protocols for line in Path("/proc/self/net", name).read_text().splitlines()[1:]]
    return [row for row in rows if f"socket:[{row[9]}]" in own]


def listening_addresses():
    """Local addresses of all listening TCP sockets of this process, as the kernel has them."""
    return {row[1].partition(":")[0] for row in own_sockets("tcp", "tcp6") if row[3] == "0A"}


@pytest.mark.req("S1")
def test_by_default_only_loopback_is_open_and_nothing_is_scouted():
    base = free_base_port()
    with Publisher(Source.GATEWAY, base), Subscriber(lambda topic, payload: None, ["state"], base):
        assert listening_addresses() == {"0100007F"}
        assert own_sockets("udp", "udp6") == []


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """Directory with the rig's certificate, those of two readers and of a stranger; `tuner` may also write."""
    directory = tmp_path_factory.mktemp("certificates")
    ours, theirs = make_authority(directory, "ours"), make_authority(directory, "theirs")
    for name in ("rig", "viewer", "tuner"):
        make_certificate(directory, name, ours)
    make_certificate(directory, "stranger", theirs)
    return directory


def tls_of(directory, name, port):
    return TlsSection(
        address=f"127.0.0.1:{port}", certificate=directory / f"{name}.pem", private_key=directory / f"{name}.key",
        authority=directory / "ours.pem", writers=("tuner",),
    )  # fmt: skip


@pytest.fixture
def rig(certificates):
    """A source that also listens with TLS; what it is asked, and a reader's session by name."""
    base = free_base_port()
    tls_port = base + 7000 if base < 50_000 else base - 7000
    asked = []
    with Publisher(Source.CONTROLLER, base, tls_of(certificates, "rig", tls_port)) as publisher:
        publisher.serve("parameters", lambda payload: asked.append(payload) or b"answer")
        heard = []
        note = zenoh.handlers.Callback(lambda sample: heard.append(str(sample.key_expr)), indirect=False)
        spy = publisher._session.declare_subscriber("xilgate/**", note)
        yield publisher, base, asked, heard, lambda name: tls_of(certificates, name, tls_port)
        spy.undeclare()


def raw_session(tls, source):
    """What a hostile program would open with this certificate."""
    return telemetry._session([], [tls.endpoint(source)], connecting_options(tls), within_s=5.0)


CHANGE = telemetry.ParametersSample(t_ns=1, seq=1, version=1, accepted_ns=1, who="a test", changes=[], reverts=[])


@pytest.mark.req("S1")
@pytest.mark.parametrize("name", ["viewer", "tuner"])
def test_who_has_a_certificate_may_read(rig, name):
    publisher, _, _, _, tls_as = rig
    received = []
    with Subscriber(lambda topic, payload: received.append(decode(topic, payload)), ["parameters"], tls=tls_as(name)):

        def has_arrived():
            publisher.post(CHANGE)
            return bool(received)

        wait_until(has_arrived, 20, "a sample over TLS")
    assert received[0] == CHANGE


@pytest.mark.req("S1")
@pytest.mark.parametrize("name", ["viewer", "tuner"])
def test_who_may_read_cannot_publish(rig, name):
    _, base, _, heard, tls_as = rig
    with raw_session(tls_as(name), Source.CONTROLLER) as session:
        for topic in ("state", "objects", "parameters", "controller/parameters", "anything/else"):
            session.put(f"xilgate/{topic}", b"forged")
            session.delete(f"xilgate/{topic}")
        with telemetry._session([], [f"tcp/127.0.0.1:{port_of(Source.CONTROLLER, base)}"], within_s=5.0) as local:

            def is_heard():
                local.put("xilgate/local", b"")
                return "xilgate/local" in heard

            wait_until(is_heard, 10, "a sample of a local session, after the forged ones")
    assert set(heard) == {"xilgate/local"}


@pytest.mark.req("S1")
def test_only_named_writers_use_services(rig):
    _, base, asked, _, tls_as = rig
    with pytest.raises(TelemetryError):
        ask(Source.CONTROLLER, "parameters", b"forged", timeout_s=1.0, tls=tls_as("viewer"))
    assert asked == []
    assert ask(Source.CONTROLLER, "parameters", b"tuned", timeout_s=10.0, tls=tls_as("tuner")) == b"answer"
    assert ask(Source.CONTROLLER, "parameters", b"local", base) == b"answer"
    assert asked == [b"tuned", b"local"]


@pytest.mark.req("S1")
def test_a_reader_cannot_pretend_to_serve(rig):
    """A queryable of a remote session on a service of ours is not known to anybody else."""
    _, base, asked, _, tls_as = rig
    with raw_session(tls_as("viewer"), Source.CONTROLLER) as session:
        session.declare_queryable("xilgate/controller/parameters", lambda query: query.reply("xilgate/controller/parameters", b"forged"))
        session.declare_queryable("xilgate/**", lambda query: query.reply("xilgate/controller/parameters", b"forged"))
        assert ask(Source.CONTROLLER, "parameters", b"local", base) == b"answer"
    assert asked == [b"local"]


@pytest.mark.req("S1")
def test_without_a_certificate_of_ours_there_is_no_session(rig):
    tls_as = rig[4]
    with pytest.raises(TelemetryError, match=r"does not accept .*stranger\.pem"):
        ask(Source.CONTROLLER, "parameters", b"forged", timeout_s=1.0, tls=tls_as("stranger"))
    authority_alone = {"transport/link/tls": {"root_ca_certificate": str(tls_as("viewer").authority)}}
    with pytest.raises(zenoh.ZError):
        telemetry._session([], [tls_as("viewer").endpoint(Source.CONTROLLER)], authority_alone, within_s=1.0)
    with pytest.raises(zenoh.ZError):
        telemetry._session([], [tls_as("viewer").endpoint(Source.CONTROLLER).replace("tls/", "tcp/")], within_s=1.0)


@pytest.mark.req("S1")
def test_a_rig_of_another_authority_is_not_believed(certificates, rig):
    """The reader checks the rig as well: here its certificate is signed by somebody else."""
    tls = rig[4]("stranger").model_copy(update={"authority": certificates / "theirs.pem"})
    with pytest.raises(TelemetryError):
        ask(Source.CONTROLLER, "parameters", b"", timeout_s=1.0, tls=tls)


@pytest.mark.req("S1")
def test_a_rig_of_another_name_is_not_believed(rig):
    """Its certificate is good, but of 127.0.0.1 alone."""
    tls = rig[4]("tuner")
    renamed = tls.model_copy(update={"address": tls.address.replace("127.0.0.1", "localhost")})
    with pytest.raises(TelemetryError):
        ask(Source.CONTROLLER, "parameters", b"", timeout_s=1.0, tls=renamed)
    assert ask(Source.CONTROLLER, "parameters", b"", timeout_s=10.0, tls=tls) == b"answer"


@pytest.mark.req("S1")
@pytest.mark.parametrize("writers", [(), ("tuner",)])
def test_the_access_list_is_no_longer_than_it_must_be(certificates, writers):
    """What a well-behaved Zenoh does not even send, because nobody has asked for it, a hostile one might."""
    tls = tls_of(certificates, "rig", 7547).model_copy(update={"writers": writers})
    access = listening_options(tls)["access_control"]
    assert (access["enabled"], access["default_permission"]) == (True, "deny")
    rules = {rule["id"]: rule for rule in access["rules"]}
    protocols = {subject["id"]: subject["link_protocols"] for subject in access["subjects"]}
    names = {subject["id"]: subject.get("cert_common_names") for subject in access["subjects"]}
    allowed = {
        (protocol, *(names[subject] or ["anybody"]), flow, message, key)
        for policy in access["policies"] for subject in policy["subjects"] for protocol in protocols[subject]
        for rule in map(rules.get, policy["rules"]) for flow in rule["flows"] for message in rule["messages"] for key in rule["key_exprs"]
    }  # fmt: skip
    remote = {one[1:] for one in allowed if one[0] != "tcp"}
    reading = {("anybody", "ingress", "declare_subscriber", "xilgate/*"), ("anybody", "egress", "put", "xilgate/*")}
    asking = {("egress", "declare_queryable"), ("ingress", "query"), ("egress", "reply")}
    assert remote == reading | {(name, *one, "xilgate/*/*") for name in writers for one in asking}


@pytest.mark.req("S1")
def test_both_sides_verify_and_end_with_their_certificates(certificates):
    tls = tls_of(certificates, "rig", 7547)
    for options in (listening_options(tls), connecting_options(tls)):
        link = options["transport/link/tls"]
        assert (link["enable_mtls"], link["verify_name_on_connect"], link["close_link_on_expiration"]) == (True, True, True)
        assert link["root_ca_certificate"] == str(tls.authority)


@pytest.mark.req("S1")
@pytest.mark.parametrize(
    "address",
    ["tcp/192.168.1.10:7547", "tls/192.168.1.10:7547", "192.168.1.10", ":7547", "192.168.1.10:80", "192.168.1.10:65531", "a b:7547", ""],
)
def test_an_address_without_tls_or_port_is_refused_by_name(tmp_path, address):
    file = tmp_path / "tls.toml"
    text = 'certificate = "a"\nprivate_key = "b"\nauthority = "c"\n'
    file.write_text(f'address = "{address}"\n' + text)
    with pytest.raises(UserMistake, match=r"tls\.toml: address = .*: allowed: ADDRESS:PORT without a protocol, it is always TLS"):
        read_section(file, TlsSection, UserMistake)
    file.write_text('address = "[fd00::1]:7547"\nwriters = ["tuner"]\n' + text)
    section = read_section(file, TlsSection, UserMistake)
    assert [section.endpoint(source) for source in Source] == [f"tls/[fd00::1]:{7547 + k}" for k in range(len(Source))]
    assert section.writers == ("tuner",)


@pytest.mark.req("S1")
def test_tls_that_cannot_be_used_is_one_line(certificates, tmp_path):
    base = free_base_port()
    tls = tls_of(certificates, "rig", base + 100)
    (tmp_path / "key").write_bytes(tls.private_key.read_bytes())
    (tmp_path / "key").chmod(0o644)
    with pytest.raises(KeyMistake, match="mode 0644"):
        Publisher(Source.GATEWAY, base, tls.model_copy(update={"private_key": tmp_path / "key"}))
    with pytest.raises(UserMistake, match=r"^/dev/zero: not a regular file$"):
        Publisher(Source.GATEWAY, base, tls.model_copy(update={"authority": Path("/dev/zero")}))
    with pytest.raises(UserMistake, match=rf"^{tmp_path}/nowhere\.pem: No such file"):
        Publisher(Source.GATEWAY, base, tls.model_copy(update={"certificate": tmp_path / "nowhere.pem"}))
    with pytest.raises(TelemetryError, match=r"viewer\.pem.* not usable") as caught:
        Publisher(Source.GATEWAY, base, tls.model_copy(update={"certificate": certificates / "viewer.pem"}))
    assert "\n" not in str(caught.value)
