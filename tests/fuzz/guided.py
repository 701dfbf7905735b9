"""`python -m tests.fuzz.guided PARSER DIRECTORY [OPTIONS OF LIBFUZZER]`: fuzz one parser, guided by the coverage of our own code."""

import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["dbc", "gateway", "controller", "vehicle_emulator", "xil"]):
    from tests.fuzz.parsers import parsers


def main() -> None:
    """Run until libFuzzer is told to stop, or a parser fails."""
    name, corpus, *options = sys.argv[1:]
    parser = parsers()[name]
    for number, example in enumerate(parser.examples):
        Path(corpus, f"example{number}").write_bytes(example)
    atheris.Setup([sys.argv[0], corpus, "-max_len=65536", *options], lambda content: parser.parse(bytes(content)))
    atheris.Fuzz()


if __name__ == "__main__":
    main()
