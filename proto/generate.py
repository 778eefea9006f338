"""Regenerate the Python code of ``comvla/v1/*.proto``: ``python proto/generate.py [--out DIR]``.

Generated code demands a protobuf runtime at least as new as its generator, and robots run old
ones. So the generator is an old one, and pinned: the output of grpcio-tools 1.62 loads on every
protobuf from 3.20 to the current release. It needs an environment of its own, because it conflicts
with the runtimes that everything else uses:

    python -m venv .venv-proto && .venv-proto/bin/pip install grpcio-tools==1.62.3
    .venv-proto/bin/python proto/generate.py
"""

from __future__ import annotations

import argparse
import sys
from importlib import metadata
from pathlib import Path

GENERATOR = "1.62.3"
ROOT = Path(__file__).resolve().parent


def generate(out: Path) -> list[Path]:
    """Write modules, stubs and gRPC classes below ``out``; returns the files written.

    Raises:
        RuntimeError: the pinned generator is not installed, or the compiler refused the files.
    """
    try:
        found = metadata.version("grpcio-tools")
    except metadata.PackageNotFoundError:
        found = "none"
    if found != GENERATOR:
        raise RuntimeError(
            f"expected grpcio-tools {GENERATOR}, got {found}: run this in an environment made by\n"
            f"  python -m venv .venv-proto && "
            f".venv-proto/bin/pip install grpcio-tools=={GENERATOR}"
        )
    import grpc_tools
    from grpc_tools import protoc

    sources = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("comvla/**/*.proto"))
    well_known = Path(grpc_tools.__file__).parent / "_proto"
    out.mkdir(parents=True, exist_ok=True)
    outputs = [f"--{kind}_out={out}" for kind in ("python", "pyi", "grpc_python")]
    arguments = ["protoc", f"-I{ROOT}", f"-I{well_known}", *outputs, *sources]
    if protoc.main(arguments) != 0:
        raise RuntimeError(f"protoc refused {', '.join(sources)}: its messages are above")
    stems = [out / Path(source).with_suffix("") for source in sources]
    endings = ("_pb2.py", "_pb2.pyi", "_pb2_grpc.py")
    return [stem.with_name(stem.name + ending) for stem in stems for ending in endings]


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description="Regenerate the Python code of the contract.")
    parser.add_argument("--out", type=Path, default=ROOT, help="source root to write into")
    try:
        written = generate(parser.parse_args().out)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    print(*written, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
