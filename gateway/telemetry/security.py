"""Telemetry for other machines: TLS with certificates on both sides, and lists of who may do what. On loopback nothing of this applies.

The same section stands in the rig file, where it opens a second set of ports, and with whoever reads, where it names those ports.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from dbc.errors import UserMistake
from dbc.section import Section, absolute, misfit, read_section
from dbc.whole_file import read_whole
from gateway.keys import check_secret
from gateway.telemetry.samples import Source, port_of

KEY_PREFIX = "xilgate"
_MAX_CERTIFICATE_BYTES = 1 << 20
_ADDRESS = re.compile(r"(?:[A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\]):([0-9]{4,5})")
_PORTS = range(1024, 65536 - len(Source))
_EVERYTHING = [
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
]
_SAMPLES, _SERVICES = f"{KEY_PREFIX}/*", f"{KEY_PREFIX}/*/*"


def _address(text: str) -> str:
    found = _ADDRESS.fullmatch(text)
    if found is None or int(found[1]) not in _PORTS:
        raise misfit(f"ADDRESS:PORT without a protocol, it is always TLS; port {_PORTS.start} to {_PORTS.stop - 1}")
    return text


_FilePath = Annotated[Path, Field(strict=False)]


class TlsSection(Section):
    """How telemetry leaves the machine.

    Args:
        address: of the rig, with the first of five neighbouring ports, one for each source as on loopback.
        certificate, private_key: this side's own, PEM; the rig's names its address as an alternative name.
        authority: certificates of those who sign for this rig, PEM. Who shows none of theirs is not let in.
        writers: common names of the certificates whose owners may use the services (parameters, faults, lift); the others only read.
    """

    address: Annotated[str, AfterValidator(_address)]
    certificate: _FilePath
    private_key: _FilePath
    authority: _FilePath
    writers: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(strict=False)] = ()

    def endpoint(self, source: Source) -> str:
        """Where a source listens, as Zenoh names it."""
        host, _, port = self.address.rpartition(":")
        return f"tls/{host}:{port_of(source, int(port))}"


class TlsMistake(UserMistake):
    """A file with a `TlsSection` cannot be used; one line per mistake, each with file, key, value and what is allowed."""


def read_tls(path: Path) -> TlsSection:
    """Read how a reader reaches a rig that is another machine. Files that it names without a leading slash are relative to it.

    Raises:
        TlsMistake: missing file, malformed TOML, unknown or missing key, value out of range.
    """
    section: TlsSection = absolute(read_section(path, TlsSection, TlsMistake), path.absolute().parent)
    return section


def listening_options(tls: TlsSection) -> Mapping[str, Any]:
    """Settings of Zenoh for the side of the rig."""
    files = {"listen_certificate": str(tls.certificate), "listen_private_key": str(tls.private_key)}
    return {"transport/link/tls": _verified(tls) | files, "access_control": _access(tls)}


def check_files(tls: TlsSection) -> None:
    """Look at the files before Zenoh does: it would try for ever to connect with what it cannot read.

    Raises:
        TlsMistake: a certificate cannot be read.
        KeyMistake: the private key cannot, or others can.
    """
    for path in (tls.certificate, tls.authority):
        try:
            read_whole(path, _MAX_CERTIFICATE_BYTES)
        except OSError as error:
            raise TlsMistake(f"{path}: {error.strerror}") from error
    check_secret(tls.private_key)


def connecting_options(tls: TlsSection) -> Mapping[str, Any]:
    """Settings of Zenoh for the other side."""
    files = {"connect_certificate": str(tls.certificate), "connect_private_key": str(tls.private_key)}
    return {"transport/link/tls": _verified(tls) | files}


def _verified(tls: TlsSection) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(tls.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def _access(tls: TlsSection) -> dict[str, Any]:
    """Who may do what; what no rule allows is refused."""

    def rule(name: str, flows: list[str], messages: list[str], key: str) -> dict[str, Any]:
        return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": [key]}

    # Plain TCP is on loopback alone.
    subjects: list[dict[str, Any]] = [{"id": "local", "link_protocols": ["tcp"]}, {"id": "reader", "link_protocols": ["tls"]}]
    policies = [
        {"subjects": ["local"], "rules": ["everything"]},
        {"subjects": ["reader"], "rules": ["subscribe", "samples"]},
    ]
    if tls.writers:
        subjects.append({"id": "writer", "link_protocols": ["tls"], "cert_common_names": list(tls.writers)})
        policies.append({"subjects": ["writer"], "rules": ["find service", "ask", "answer"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            rule("everything", ["ingress", "egress"], _EVERYTHING, "**"),
            rule("subscribe", ["ingress"], ["declare_subscriber"], _SAMPLES),
            rule("samples", ["egress"], ["put"], _SAMPLES),
            rule("find service", ["egress"], ["declare_queryable"], _SERVICES),
            rule("ask", ["ingress"], ["query"], _SERVICES),
            rule("answer", ["egress"], ["reply"], _SERVICES),
        ],
        "subjects": subjects,
        "policies": policies,
    }
