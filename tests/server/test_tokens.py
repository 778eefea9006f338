"""Tokens files: what they hold, how they change, and the command that writes them."""

from __future__ import annotations

import logging
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla_server import cli
from comvla_server.identity import Identity, Limits
from comvla_server.secret_files import warn_if_exposed
from comvla_server.tokens import (
    TokenFile,
    TokenLine,
    TokensError,
    TokenTable,
    masked,
    new_token,
    read_lines,
)

ARM = Identity("arm-7")


def test_a_token_is_found_by_its_hash_and_nothing_else() -> None:
    token = new_token()
    table = TokenTable([TokenLine.of(ARM, token)])
    assert table.find(token) == ARM
    for wrong in ("", token[:-1], token + "x", token.upper(), "sha256:", "é" * 40, "x" * 10_000):
        assert table.find(wrong) is None
    digest = TokenLine.of(ARM, token).digest
    assert table.find(digest.hex()) is None, "the file alone opens nothing"


@given(st.text())
def test_no_text_is_a_token_by_chance_or_breaks_the_look_up(text: str) -> None:
    assert TokenTable([TokenLine.of(ARM, "cvt_secret")]).find(text) is None


def test_tokens_are_long_and_never_the_same() -> None:
    tokens = {new_token() for _ in range(100)}
    assert len(tokens) == 100
    assert all(len(token) >= 4 + 43 for token in tokens)


def test_a_token_is_masked_in_whatever_is_printed() -> None:
    token = new_token()
    assert token[4:] not in masked(f"Bearer {token}, please")


limit = st.none() | st.floats(min_value=1e-3, max_value=1e9)


@given(limit, limit, st.none() | st.integers(min_value=1, max_value=2**40))
def test_a_line_reads_back_what_was_written(
    tmp_path_factory: pytest.TempPathFactory,
    requests_per_s: float | None,
    bytes_per_s: float | None,
    max_request_bytes: int | None,
) -> None:
    limits = Limits(requests_per_s, bytes_per_s, max_request_bytes)
    path = tmp_path_factory.mktemp("tokens") / "tokens"
    path.write_text(
        f"# robots\n\n{TokenLine.of(Identity('arm', limits), 'cvt_x')}  # the left one\n"
    )
    (line,) = read_lines(path, "tokens_file")
    assert line.identity == Identity("arm", limits)


GOOD = f"arm-7 sha256:{'0' * 64}"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "holds no token"),
        ("# nobody yet\n", "comvla-server token new"),
        ("arm-7 cvt_oh-no-a-secret", "line 1: expected IDENTITY sha256:HEX"),
        (f"{GOOD}\narm 8", "line 2: expected IDENTITY"),
        (f"-arm {GOOD.split()[1]}", "line 1"),
        (f"{GOOD[:-1]}", "line 1"),
        (f"{GOOD} speed=3", "expected limits requests_per_s, bytes_per_s, max_request_bytes"),
        (f"{GOOD} requests_per_s=nan", "finite number above 0"),
        (f"{GOOD} requests_per_s=-1", "finite number above 0"),
        (f"{GOOD} requests_per_s=many", "finite number above 0"),
        (f"{GOOD} bytes_per_s=1 bytes_per_s=2", "at most once"),
        (f"{GOOD}\n{GOOD} bytes_per_s=1", "line 2: arm-7 has other limits"),
    ],
)
def test_a_wrong_file_is_refused_by_line_and_never_quoted(
    tmp_path: Path, content: str, words: str
) -> None:
    path = tmp_path / "tokens"
    path.write_text(content)
    with pytest.raises(TokensError, match=words) as caught:
        TokenFile(path, "tokens_file")
    assert "oh-no" not in str(caught.value)


def test_an_unreadable_file_is_named_with_a_remedy(tmp_path: Path) -> None:
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(TokensError, match=r"cannot read .*tokens_file.*correct the path"):
            TokenFile(path, "tokens_file")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    with pytest.raises(TokensError, match="is not text"):
        TokenFile(tmp_path / "binary", "tokens_file")
    with pytest.raises(TokensError, match="larger than"):
        TokenFile(Path("/dev/zero"), "tokens_file")


def test_a_file_that_breaks_leaves_what_was_known(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    path.write_text(f"{TokenLine.of(ARM, 'cvt_a')}\n")
    tokens = TokenFile(path, "tokens_file")
    path.write_text("broken")
    with pytest.raises(TokensError):
        tokens.reload()
    assert tokens.find("cvt_a") == ARM
    path.write_text(f"{TokenLine.of(ARM, 'cvt_b')}\n")
    tokens.reload()
    assert tokens.find("cvt_a") is None
    assert tokens.find("cvt_b") == ARM


def test_new_prints_the_secret_once_and_keeps_its_hash(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "tokens"
    limits = ["--requests-per-s", "20", "--max-request-bytes", "300000"]
    assert cli.main(["token", "new", "arm-7", "--file", str(path), *limits]) == 0
    stdout, stderr = capsys.readouterr()
    token = stdout.strip()
    assert stdout == f"{token}\n"
    assert token not in stderr
    assert token not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    found = TokenFile(path, "tokens_file").find(token)
    assert found == Identity("arm-7", Limits(20.0, None, 300_000))


def test_tokens_that_are_made_at_once_are_all_kept(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    robots = [f"arm-{number}" for number in range(24)]
    with ThreadPoolExecutor(8) as pool:
        results = pool.map(
            lambda name: cli.main(["token", "new", name, "--file", str(path)]), robots
        )
        assert set(results) == {0}
    assert sorted(line.identity.name for line in read_lines(path, "--file")) == sorted(robots)


def test_tokens_are_listed_and_revoked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tokens"
    file = ["--file", str(path)]
    # No end of line at the end.
    path.write_text(f"# the fleet\n{TokenLine.of(Identity('arm-1'), 'cvt_1')}")
    for name in ("arm-7", "arm-7", "arm-8"):
        assert cli.main(["token", "new", name, *file]) == 0
    first, second, third = capsys.readouterr().out.split()
    assert cli.main(["token", "list", *file]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [name for name, _ in rows] == ["arm-1", "arm-7", "arm-7", "arm-8"]
    digest = rows[1][1].removeprefix("sha256:")

    assert cli.main(["token", "revoke", "arm-7", "--digest", digest, *file]) == 0
    tokens = TokenFile(path, "tokens_file")
    assert [tokens.find(token) for token in (first, second)] == [None, ARM]
    assert cli.main(["token", "revoke", "arm-7", *file]) == 0
    tokens.reload()
    assert tokens.find(second) is None
    assert tokens.find(third) is not None
    assert path.read_text().startswith("# the fleet\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("new", "arm 7"), "expected an identity"),
        (("new", "arm-8", "--bytes-per-s", "0"), "finite number above 0"),
        (("new", "arm-7", "--bytes-per-s", "5"), "other limits"),
        (("revoke", "arm-9"), "no such token of arm-9"),
        (("revoke", "arm-7"), "without any token"),
    ],
)
def test_mistakes_leave_the_file_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    path = tmp_path / "tokens"
    path.write_text(f"{TokenLine.of(ARM, 'cvt_a')}\n")
    before = path.read_text()
    assert cli.main(["token", *arguments, "--file", str(path)]) == 2
    assert words in capsys.readouterr().err
    assert path.read_text() == before


def test_a_file_that_cannot_be_written_is_exit_code_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["token", "new", "arm-7", "--file", str(tmp_path / "no" / "tokens")]) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "", "a secret that was not kept is not shown"
    assert "cannot write" in stderr


def test_a_file_that_others_may_read_is_warned_about(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    path = tmp_path / "tokens"
    path.touch(mode=0o600)
    warn_if_exposed(path, "tokens_file")
    assert not caplog.records
    path.chmod(0o604)
    warn_if_exposed(path, "tokens_file")
    assert "mode 604" in caplog.text
