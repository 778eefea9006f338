"""Flags over environment over file over defaults, and what is refused on the way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from comvla_server import cli
from comvla_server.setting_fields import SettingsError, fields_of
from comvla_server.settings import ServerSettings
from comvla_server.settings_flags import settings_of
from comvla_server.settings_sources import resolve

FIELDS = fields_of(ServerSettings)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A configuration file."""
    path = tmp_path / "comvla.toml"
    path.write_text('max_batch = 2\nmax_queue = 20\nport = 7000\ndtype = "bfloat16"\n')
    return path


def test_flags_win_over_the_environment_over_the_file_over_defaults(config: Path) -> None:
    in_force = resolve(
        {"port": "9000"},
        {"COMVLA_PORT": "8000", "COMVLA_MAX_QUEUE": "30", "COMVLA_CONFIG": str(config)},
    )
    settings, origins = in_force.settings, in_force.origins
    assert (settings.port, str(origins["port"])) == (9000, "flag --port")
    assert (settings.max_queue, str(origins["max_queue"])) == (30, "environment COMVLA_MAX_QUEUE")
    assert (settings.max_batch, str(origins["max_batch"])) == (2, f"file {config}")
    assert (settings.max_sessions, str(origins["max_sessions"])) == (1024, "default")


def test_every_setting_can_be_given_in_every_way(tmp_path: Path) -> None:
    texts = {
        "fastv": "3,0.75",
        "admin_host": "::1",
        "threads": "4",
        "statistics_key": "libero",
        "otel_endpoint": "http://127.0.0.1:4318/v1/traces",
    }
    alone = {"tls_certificate", "tls_key", "tls_client_ca", "open_metrics", "insecure"}
    for name, field in FIELDS.items():
        if name in alone or name.startswith("identity_"):
            continue  # these need one another, or a tokens file
        if field.declared.choices:
            text = field.declared.choices[-1]
        elif field.kind is bool:
            text = "true"
        elif field.default is None:
            text = texts.get(name, "/some/file")
        else:
            text = str(field.serve_default)
        by_flag = resolve({name: text}, {})
        by_variable = resolve({}, {field.variable: text})
        bare = text in ("true", "false") or field.kind in (int, float, int | None)
        path = tmp_path / "one.toml"
        path.write_text(f"{name} = {text if bare else json.dumps(text)}\n")
        by_file = resolve({}, {}, str(path))
        values = {getattr(found.settings, name) for found in (by_flag, by_variable, by_file)}
        assert len(values) == 1, name
        assert [found.origins[name].source for found in (by_flag, by_variable, by_file)] == [
            "flag",
            "environment",
            "file",
        ]


def test_paths_in_a_file_are_relative_to_it(config: Path) -> None:
    config.write_text('tokens_file = "secrets/tokens"\n')
    assert resolve({}, {}, str(config)).settings.tokens_file == config.parent / "secrets" / "tokens"
    assert resolve({"tokens_file": "tokens"}, {}).settings.tokens_file == Path("tokens")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("max_bacth = 3", ("max_bacth", "did you mean max_batch?")),
        ("zebra = 3", ("zebra", "comvla-server config")),
        ("max_batch = true", ("max_batch", "a whole number", "True")),
        ("max_batch = 2.0", ("max_batch", "a whole number", "2.0")),
        ("insecure = 1", ("insecure", "true or false")),
        ('grace_s = "soon"', ("grace_s", "a number", "'soon'")),
        ("fastv = [0, 0.5]", ("fastv must be a layer >= 1",)),
        ("fastv = [1]", ("fastv", "LAYER,DROP")),
        ("max_batch 3", ("is not TOML", "max_batch = 8")),
        ("[limits]\nmax_batch = 3", ("limits",)),
    ],
)
def test_a_wrong_file_is_refused_with_a_remedy(
    config: Path, content: str, words: tuple[str, ...]
) -> None:
    config.write_text(content)
    with pytest.raises(SettingsError) as caught:
        resolve({}, {}, str(config))
    for word in words:
        assert word in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"nowhere.toml.*correct --config"):
        resolve({}, {}, str(tmp_path / "nowhere.toml"))


@pytest.mark.parametrize(
    ("environment", "words"),
    [
        ({"COMVLA_MAX_BACTH": "3"}, ("COMVLA_MAX_BACTH", "did you mean COMVLA_MAX_BATCH?")),
        ({"COMVLA_MAX_BATCH": "many"}, ("COMVLA_MAX_BATCH must be a whole number", "'many'")),
        ({"COMVLA_PORT": "tcp://10.0.0.7:50051"}, ("Kubernetes", "enableServiceLinks: false")),
        ({"COMVLA_MAX_QUEUE": "nan"}, ("COMVLA_MAX_QUEUE",)),
        ({"COMVLA_GRACE_S": "nan"}, ("grace_s must be a finite number of seconds", "nan")),
        ({"COMVLA_IDENTITY_BYTES_PER_S": "-1"}, ("finite number of bytes per second",)),
    ],
)
def test_a_wrong_environment_is_refused_with_a_remedy(
    environment: dict[str, str], words: tuple[str, ...]
) -> None:
    with pytest.raises(SettingsError) as caught:
        resolve({}, environment)
    for word in words:
        assert word in str(caught.value)


def test_variables_of_others_are_left_alone() -> None:
    resolve(
        {},
        {
            "COMVLA_SERVICE_HOST": "10.0.0.7",
            "COMVLA_SERVER_PORT_50051_TCP_ADDR": "10.0.0.7",
            "COMVLA_LIBERO_ENV": "/opt/libero",
            "PATH": "/bin",
        },
    )


def test_a_secret_in_the_wrong_place_is_not_repeated() -> None:
    with pytest.raises(SettingsError) as caught:
        resolve({}, {"COMVLA_ADMIN_TOKEN": "cvt_hush"})
    assert "hush" not in str(caught.value)


CONTRADICTIONS = [
    ({"tls_key": "k"}, "tls_key is given without tls_certificate"),
    ({"tls_certificate": "c"}, "tls_certificate is given without tls_key"),
    ({"tls_client_ca": "ca"}, "tls_client_ca is given without TLS"),
    ({"insecure": True, "tls_certificate": "c", "tls_key": "k"}, "contradict each other"),
    ({"port": 5000, "admin_port": 5000}, "both 5000"),
    ({"host": "0.0.0.0"}, "give --tls-certificate and --tls-key.*--insecure"),
    ({"host": "robots.example"}, "--insecure"),
    ({"admin_host": "0.0.0.0"}, "0.0.0.0 is reached from beyond this machine"),
    ({"identity_requests_per_s": 5.0}, "nothing tells robots apart"),
    ({"open_metrics": True}, "admin-tokens-file"),
    ({"tokens_file": "t", "admin_tokens_file": "t"}, "must not open the admin surface"),
]


@pytest.mark.parametrize(("changes", "words"), CONTRADICTIONS)
def test_contradictions_are_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        ServerSettings(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("command", ["serve", "config"])
def test_beyond_this_machine_without_tls_is_exit_code_two_and_says_the_remedy(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([command, "--host", "0.0.0.0"]) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == ""
    for words in ("beyond this machine", "--tls-certificate", "--insecure"):
        assert words in stderr
    assert len(stderr.splitlines()) == 1


def test_config_prints_what_is_in_force_and_why(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COMVLA_MAX_QUEUE", "30")
    arguments = ["config", "--config", str(config), "--grace-s", "3"]
    assert cli.main([*arguments, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["settings"]
    assert set(shown) == set(FIELDS)
    assert shown["max_batch"] == {"value": 2, "source": "file", "where": str(config)}
    assert shown["max_queue"] == {
        "value": 30,
        "source": "environment",
        "where": "COMVLA_MAX_QUEUE",
    }
    assert shown["grace_s"] == {"value": 3.0, "source": "flag", "where": "--grace-s"}
    assert shown["admin_port"] == {"value": 8080, "source": "default", "where": ""}
    assert cli.main(arguments) == 0
    lines = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()}
    assert lines["grace_s"] == ["3.0", "flag", "--grace-s"]
    assert lines["threads"] == ["-", "default"]


def test_config_masks_a_secret_that_was_given_for_a_file(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for output in ([], ["--json"]):
        assert cli.main(["config", "--tokens-file", "cvt_hushhush", *output]) == 0
        assert "hush" not in capsys.readouterr().out


def test_no_option_takes_a_secret() -> None:
    words = ("token", "key", "password")
    counts = ("advise_tokens", "advise_least_tokens")  # of another kind: visual tokens
    secret = [name for name in FIELDS if any(word in name for word in words)]
    secret = [name for name in secret if name not in counts]
    assert secret == ["statistics_key", "tls_key", "tokens_file", "admin_tokens_file"]
    assert all(FIELDS[name].declared.path for name in secret[1:])


def test_a_boolean_can_be_turned_off_again(config: Path) -> None:
    config.write_text("compile = true\n")
    parsed = cli.build_parser().parse_args(["serve", "--config", str(config), "--no-compile"])
    assert settings_of(parsed, {}).settings.compile is False
