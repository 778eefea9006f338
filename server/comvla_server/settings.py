"""What an operator may choose about a server: the one model of its settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from comvla_server.contradictions import check_together
from comvla_server.model_names import join_models, parse_models
from comvla_server.setting_fields import SettingsError, check_value, fields_of, setting

__all__ = ["ServerSettings", "SettingsError"]

MODEL, NETWORK, TLS = "model", "network", "encryption"
ACCESS, LIMITS, CONNECTIONS = "who may call", "limits", "connections"
OVERLOAD = "when more is asked than can be answered"
LOGS, TRACES = "logs, on stderr", "traces (OpenTelemetry)"


def _fastv(text: str) -> tuple[int, float]:
    layer, _, drop = text.partition(",")
    return int(layer), float(drop)


@dataclass(frozen=True, kw_only=True)
class ServerSettings:
    """Settings of one :class:`comvla_server.server.Server`, checked when they are made.

    Each is a flag of ``comvla-server serve``, an environment variable ``COMVLA_…`` and a key of a
    TOML file as well. Those of the groups *model* and *logs* matter to the command line only: in
    code an engine is made, and logging set up, by whoever makes the server.

    Raises:
        SettingsError: a value out of its range, or values that contradict one another.
    """

    model: str = setting(
        "mini",
        "checkpoint folder, hf://owner/name on the hub, or mini, the shipped policy. For several give "
        "NAME=SOURCE for each: robots choose by name, and the first is the default",
        MODEL,
        metavar="SOURCE",
        join=join_models,
    )
    device: str = setting("cpu", "torch device, e.g. cuda:0", MODEL)
    dtype: str = setting(
        "float32",
        "number format of the weights",
        MODEL,
        choices=("float32", "bfloat16", "float16"),
    )
    threads: int | None = setting(
        None, "CPU threads of the model; torch decides where not given", MODEL, low=1, high=4096
    )
    statistics_key: str | None = setting(
        None,
        "data set whose statistics apply, where the checkpoint holds several",
        MODEL,
        metavar="KEY",
    )
    vision: str = setting(
        "auto",
        "also load the vision half, for robots that send pictures; auto: where the checkpoint on this "
        "machine is whole. It takes the memory of the towers, which the log names",
        MODEL,
        choices=("auto", "on", "off"),
    )
    fastv: tuple[int, float] | None = setting(
        None,
        "drop this share of the visual tokens before this layer, e.g. 3,0.75: saves operations, not bytes",
        MODEL,
        metavar="LAYER,DROP",
        parse=_fastv,
    )
    compact_positions: bool = setting(
        False, "number the tokens that arrive 0, 1, 2, …, as VLA-ADP does", MODEL
    )
    compile: bool = setting(False, "run the backbone through torch.compile", MODEL)
    verify: bool = setting(
        True,
        "compare weights with the digests beside them: 0.7 s of a core per GB, beside the reading",
        MODEL,
    )

    host: str = setting("127.0.0.1", "address to listen on; 0.0.0.0 for all", NETWORK)
    port: int = setting(
        0,
        "gRPC port, 0 for a free one",
        NETWORK,
        high=65535,
        hint="0 takes a free port",
        serve_default=50051,
    )
    admin_host: str | None = setting(
        None, "address of the admin surface; that of --host where not given", NETWORK
    )
    admin_port: int = setting(
        0,
        "HTTP port of /metrics, /readyz and the page, 0 for a free one",
        NETWORK,
        metavar="PORT",
        high=65535,
        hint="0 takes a free port",
        serve_default=8080,
    )
    insecure: bool = setting(
        False,
        "listen beyond this machine without TLS: whoever is on the way reads and alters everything",
        NETWORK,
    )

    tls_certificate: Path | None = setting(
        None, "certificate chain of this server, PEM; turns on TLS on both ports", TLS, path=True
    )
    tls_key: Path | None = setting(None, "its private key, PEM, not encrypted", TLS, path=True)
    tls_client_ca: Path | None = setting(
        None,
        "authorities whose certificates robots must show, PEM; turns on mutual TLS on the gRPC port",
        TLS,
        path=True,
    )

    tokens_file: Path | None = setting(
        None, "robots' hashed tokens: see comvla-server token", ACCESS, path=True
    )
    admin_tokens_file: Path | None = setting(
        None, "hashed tokens of operators and Prometheus, for the admin surface", ACCESS, path=True
    )
    open_metrics: bool = setting(False, "let /metrics be read without a token", ACCESS)
    identity_requests_per_s: float = setting(
        0.0, "calls that one robot may make, 0 for no limit", ACCESS, unit="calls per second"
    )
    identity_bytes_per_s: float = setting(
        0.0, "bytes that one robot may send, 0 for no limit", ACCESS, unit="bytes per second"
    )
    identity_max_calls: int = setting(
        64, "calls that one robot may have open at once", ACCESS, low=1, high=1_000_000
    )
    reload_interval_s: float = setting(
        2.0, "how often certificates and tokens are looked at for changes", ACCESS, above_zero=True
    )

    max_batch: int = setting(
        8,
        "most requests in one forward pass; 1 turns batching off",
        LIMITS,
        low=1,
        high=1024,
        hint="1 turns batching off",
    )
    max_queue: int = setting(
        64,
        "most robots that may wait; one more is answered RESOURCE_EXHAUSTED",
        LIMITS,
        low=1,
        high=100_000,
        hint="64 suits some tens of robots",
    )
    max_sessions: int = setting(
        1024, "most sessions whose last answer is kept for a retry", LIMITS, high=10_000_000
    )
    session_ttl_s: float = setting(
        600.0,
        "silence after which a session is forgotten and may count from 0 again",
        LIMITS,
        above_zero=True,
    )
    max_request_bytes: int = setting(
        8 * 2**20,
        "largest request, bytes",
        LIMITS,
        low=1024,
        high=2**30,
        hint="8388608 holds 512 float32 tokens of 2176",
    )
    max_bytes_in_flight: int = setting(
        512 * 2**20,
        "most bytes that all open calls may hold together, as messages and as decoded tokens",
        LIMITS,
        high=2**40,
        hint="it holds one request and its tokens",
    )
    max_concurrent_calls: int = setting(
        1024,
        "most calls open at once, health watchers included",
        LIMITS,
        low=1,
        high=1_000_000,
        hint="1024 suits most",
    )
    default_deadline_s: float = setting(
        5.0, "deadline of calls that bring none", LIMITS, above_zero=True
    )
    grace_s: float = setting(10.0, "time that calls in flight get when the server stops", LIMITS)

    admission: bool = setting(
        True, "turn away at the door what cannot be answered by its deadline", OVERLOAD
    )
    fair_shares: bool = setting(
        True,
        "under overload turn away first the robots that got more answers lately than the others",
        OVERLOAD,
    )
    earliest_deadline_first: bool = setting(
        True, "compute in the order of deadlines instead of arrival", OVERLOAD
    )
    deadline_margin_s: float = setting(
        0.005, "how long before its deadline an answer has to be ready, to arrive in time", OVERLOAD
    )
    advise_tokens: bool = setting(
        True, "tell robots how many tokens the server can take from each of them", OVERLOAD
    )
    advise_least_tokens: int = setting(
        20, "never advise fewer tokens than this", OVERLOAD, low=1, hint="policies fail on too few"
    )
    advise_target_load: float = setting(
        0.8,
        "share of its capacity that the server wants to be asked for",
        OVERLOAD,
        above_zero=True,
        unit="its capacity",
    )

    max_connections: int = setting(
        1024,
        "most connections to the gRPC port; one more is closed at once",
        CONNECTIONS,
        low=1,
        high=1_000_000,
    )
    max_calls_per_connection: int = setting(
        1024, "most calls open on one connection; more wait at the client", CONNECTIONS, low=1
    )
    max_metadata_bytes: int = setting(
        16 * 1024,
        "largest header of a call, bytes",
        CONNECTIONS,
        low=4096,
        high=2**20,
        hint="16384 holds every header of this project many times",
    )
    handshake_timeout_s: float = setting(
        10.0, "time to finish TLS and HTTP/2 handshakes", CONNECTIONS, above_zero=True
    )
    request_timeout_s: float = setting(
        10.0, "time in which a request must arrive whole", CONNECTIONS, above_zero=True
    )
    connection_idle_s: float = setting(
        600.0, "after so long without a call a connection is closed", CONNECTIONS, above_zero=True
    )
    connection_age_s: float = setting(
        3600.0,
        "after so long a robot has to connect anew, with the certificates of then",
        CONNECTIONS,
        above_zero=True,
    )
    min_ping_interval_s: float = setting(
        5.0,
        "a client whose keepalive pings come faster loses its connection; robots ping every 10 s",
        CONNECTIONS,
        above_zero=True,
    )

    log_format: str = setting("plain", "of each line", LOGS, choices=("plain", "json"))
    log_level: str = setting(
        "info",
        "lowest level shown",
        LOGS,
        choices=("debug", "info", "warning", "error"),
    )

    otel_endpoint: str | None = setting(
        None,
        "where traces go over OTLP/HTTP, e.g. http://127.0.0.1:4318/v1/traces; none where not given",
        TRACES,
        metavar="URL",
    )
    otel_sample: float = setting(
        1.0,
        "share of the calls traced that are not part of a robot's trace, 0 to 1",
        TRACES,
        unit="share",
    )

    def __post_init__(self) -> None:
        """Refuses what cannot work."""
        fields = fields_of(type(self))
        for name, field in fields.items():
            value = getattr(self, name)
            if field.declared.path and isinstance(value, str):
                value = Path(value)
                object.__setattr__(self, name, value)
            check_value(field, value)
        check_together(self)

    @property
    def models(self) -> dict[str, str]:
        """Checkpoints by the names under which robots ask for them, the default first."""
        return parse_models(self.model)

    @property
    def tls(self) -> bool:
        """Whether both ports are encrypted."""
        return self.tls_certificate is not None

    @property
    def authenticates(self) -> bool:
        """Whether every robot has to say, and prove, who it is."""
        return self.tokens_file is not None or self.tls_client_ca is not None

    @property
    def admin_address(self) -> str:
        """Where the admin surface listens."""
        return self.host if self.admin_host is None else self.admin_host
