"""The committed code is what the pinned generator makes of the .proto, and loads on old runtimes."""

from __future__ import annotations

import ast
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from google.protobuf import descriptor_pb2

from comvla import codec
from comvla.v1 import policy_pb2

ROOT = Path(__file__).resolve().parents[2]
PROTO = ROOT / "proto"
GENERATED = [
    Path("comvla/v1") / name for name in ("policy_pb2.py", "policy_pb2.pyi", "policy_pb2_grpc.py")
]


def load_generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", PROTO / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def generator_python() -> str:
    """A Python that has the pinned generator, or skip."""
    wanted = load_generate().GENERATOR
    try:
        if metadata.version("grpcio-tools") == wanted:
            return sys.executable
    except metadata.PackageNotFoundError:
        pass
    made_by_make = ROOT / ".venv-proto" / "bin" / "python"
    named = os.environ.get("COMVLA_PROTO_PYTHON", "")
    python = named or (str(made_by_make) if made_by_make.exists() else "")
    if not python:
        pytest.skip(
            f"grpcio-tools {wanted} is not installed here: run `make proto` once, or name a Python "
            "that has it in COMVLA_PROTO_PYTHON"
        )
    return python


def buf() -> str:
    """The buf binary, or skip."""
    beside_python = Path(sysconfig.get_path("scripts")) / "buf"
    found = str(beside_python) if beside_python.exists() else shutil.which("buf")
    if not found:
        pytest.skip("buf is not installed: pip install buf-bin")
    return found


def run(*command: str | Path) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, check=False, timeout=120)


def test_regenerating_changes_nothing(tmp_path: Path) -> None:
    result = run(generator_python(), PROTO / "generate.py", "--out", tmp_path)
    assert result.returncode == 0, result.stderr.decode()
    for path in GENERATED:
        assert (tmp_path / path).read_text() == (PROTO / path).read_text(), (
            f"run make proto: {path}"
        )


def test_the_committed_code_describes_the_proto_file() -> None:
    """The same question asked of an independent compiler, which every developer has."""
    built = run(buf(), "build", "proto", "--exclude-source-info", "--as-file-descriptor-set", "-o-")
    assert built.returncode == 0, built.stderr.decode()
    (compiled,) = descriptor_pb2.FileDescriptorSet.FromString(built.stdout).file
    for message in compiled.message_type:
        for field in message.field:
            field.ClearField("json_name")  # derived; generated code leaves it out
    committed = descriptor_pb2.FileDescriptorProto.FromString(policy_pb2.DESCRIPTOR.serialized_pb)
    assert committed == compiled, "policy.proto has changed: run make proto"


def test_the_proto_is_clean_to_buf_lint() -> None:
    result = run(buf(), "lint", "proto")
    assert result.returncode == 0, result.stdout.decode()


def test_the_generator_refuses_another_version_and_names_the_remedy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generate = load_generate()
    monkeypatch.setattr(generate.metadata, "version", lambda name: "1.85.0")
    monkeypatch.setattr(sys, "argv", ["generate.py", "--out", str(tmp_path)])
    assert generate.main() == 1
    assert "expected grpcio-tools 1.62.3, got 1.85.0" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_generated_code_demands_no_new_runtime() -> None:
    """Newer generators insert version checks that refuse protobuf and grpcio of a robot's age."""
    messages, _, services = ((PROTO / path).read_text() for path in GENERATED)
    assert "# Protobuf Python Version: 4.25." in messages
    assert "runtime_version" not in messages
    assert "GRPC_GENERATED_VERSION" not in services
    assert "_registered_method" not in services


@pytest.mark.parametrize("implementation", ["upb", "python"])
def test_the_messages_load_in_both_implementations_of_protobuf(implementation: str) -> None:
    probe = (
        f"from google.protobuf.internal import api_implementation as a; assert a.Type() == {implementation!r};"
        "from comvla.v1 import policy_pb2 as p;"
        "m = p.InferRequest(step=3, proprio=[1, 2], payload=b'x', snr_db=0);"
        "n = p.InferRequest.FromString(m.SerializeToString());"
        "assert n == m and n.HasField('snr_db') and not n.HasField('snr_age_s')"
    )
    result = subprocess.run(
        [sys.executable, "-c", probe],
        env={**os.environ, "PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION": implementation},
        capture_output=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr.decode()


def test_payload_headers_and_messages_number_quantizations_alike() -> None:
    for name in codec.QUANTIZATIONS:
        number = policy_pb2.Quantization.Value(f"QUANTIZATION_{name.upper()}")
        assert codec.encode(np.ones((1, 2), np.float32), [0], name)[5] == number
    assert len(policy_pb2.Quantization.items()) == 1 + len(codec.QUANTIZATIONS)


def test_the_typed_stub_names_every_method_of_the_service() -> None:
    stub = ast.parse((PROTO / "comvla/v1/policy_pb2_grpc.pyi").read_text())
    methods = {
        method.name for method in policy_pb2.DESCRIPTOR.services_by_name["PolicyService"].methods
    }
    declared = {
        node.name: {
            part.name if isinstance(part, ast.FunctionDef) else part.target.id
            for part in node.body
            if isinstance(part, ast.FunctionDef | ast.AnnAssign)
        }
        - {"__init__"}
        for node in stub.body
        if isinstance(node, ast.ClassDef) and node.name.startswith("PolicyService")
    }
    assert declared == dict.fromkeys(
        ("PolicyServiceStub", "PolicyServiceServicer", "PolicyService"), methods
    )


# Robots in the field hold these numbers. Fields may be added; none may move, go, or change type.
FROZEN = {
    "GetModelRequest": "protocol_version",
    "GetModelResponse": "protocol_version model_name model_fingerprint num_tokens token_dim "
    "tower_dims grid action_horizon action_dim proprio_dim max_prompt_tokens delta_actions "
    "control_period_s quantizations max_request_bytes server_version image_size",
    "InferRequest": "session_id step instruction proprio payload model_fingerprint snr_db "
    "snr_age_s protocol_version",
    "InferResponse": "session_id step actions action_horizon action_dim tokens_used batch_size "
    "cloud_flops timings load model_fingerprint",
    "ServerTimings": "decode_s queue_s predict_s total_s",
    "LoadHint": "queue_depth utilization suggested_tokens",
}


@pytest.mark.parametrize("message", FROZEN)
def test_published_fields_keep_their_numbers(message: str) -> None:
    fields = policy_pb2.DESCRIPTOR.message_types_by_name[message].fields_by_name
    names = FROZEN[message].split()
    assert {name: fields[name].number for name in names} == {
        name: number for number, name in enumerate(names, start=1)
    }
