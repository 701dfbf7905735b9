"""Certificates for tests: authorities and the owners that they vouch for, made by openssl."""

import subprocess
from pathlib import Path

_NEW = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]


def _openssl(*arguments: str) -> None:
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


def make_authority(directory: Path, name: str) -> Path:
    """A certificate that signs others; its key is beside it."""
    certificate = directory / f"{name}.pem"
    _openssl(
        "req", "-x509", *_NEW, "-keyout", str(directory / f"{name}.key"), "-out", str(certificate), "-days", "2", "-subj", f"/CN={name}",
        "-addext", "basicConstraints=critical,CA:TRUE",
    )  # fmt: skip
    return certificate


def make_certificate(directory: Path, name: str, authority: Path) -> tuple[Path, Path]:
    """Certificate and private key of an owner on 127.0.0.1, by the common name that he shall have."""
    certificate, key, request = (directory / f"{name}.{suffix}" for suffix in ("pem", "key", "csr"))
    extensions = directory / "extensions"
    extensions.write_text("subjectAltName=IP:127.0.0.1\nextendedKeyUsage=serverAuth,clientAuth\nbasicConstraints=CA:FALSE\n")
    _openssl("req", *_NEW, "-keyout", str(key), "-out", str(request), "-subj", f"/CN={name}")
    _openssl(
        "x509", "-req", "-in", str(request), "-CA", str(authority), "-CAkey", str(authority.with_suffix(".key")), "-CAcreateserial",
        "-days", "2", "-extfile", str(extensions), "-out", str(certificate),
    )  # fmt: skip
    return certificate, key
