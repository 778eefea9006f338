"""Starts the child. Run as a file by LIBERO's Python: ``python -I __main__.py SUITE ...``."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

_PACKAGE = "comvla_libero_child"


def load_package() -> None:
    """Makes this folder importable as a package of its own.

    Its real parent package needs Gymnasium and ComVLA, which are not installed here, and putting
    its source root on the path would expose this Python to packages that are not meant for it.
    """
    folder = Path(__file__).resolve().parent
    spec = importlib.util.spec_from_file_location(
        _PACKAGE, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[_PACKAGE] = module
    spec.loader.exec_module(module)


def take_pipes() -> tuple[Any, Any]:
    """The pipe as (reader, writer), with nothing else able to read from or print into it.

    LIBERO prints to stdout and may prompt on stdin: the one now goes to stderr, the other is empty.
    """
    reader = os.fdopen(os.dup(0), "rb")
    writer = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    return reader, writer


def main() -> int:
    """Serves until the parent closes the pipe."""
    reader, writer = take_pipes()
    load_package()
    server = importlib.import_module(f"{_PACKAGE}.server")
    options = importlib.import_module(f"{_PACKAGE}.options").Options.from_json(sys.argv[1])

    def start() -> Any:
        return importlib.import_module(f"{_PACKAGE}.simulation").Simulation(options)

    server.serve(reader, writer, start)
    return 0


if __name__ == "__main__":
    sys.exit(main())
