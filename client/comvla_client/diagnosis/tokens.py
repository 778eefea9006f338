"""How many tokens the link carries, and how often a robot can ask."""

from __future__ import annotations

from comvla import codec
from comvla.model_info import ModelInfo
from comvla_client.budget import LinkProfile, framed_token_budget, token_budget
from comvla_client.diagnosis.finding import Finding
from comvla_client.diagnosis.goodput import Goodput

USEFUL_TOKENS = 20
"""Fewer than about this many of 512 tokens, and the paper's success collapses (Table I, K = 16)."""

_TOO_FEW = f"below about {USEFUL_TOKENS} tokens policies lose the task: "


def framed_budget(snr_db: float, link: LinkProfile, model: ModelInfo, quantization: str) -> int:
    """K* of a model's tokens with all bytes counted."""
    return framed_token_budget(
        snr_db,
        link,
        token_dim=model.token_dim,
        quantization=quantization,
        num_towers=len(model.tower_dims),
        proprio_dim=model.proprio_dim,
        model_fingerprint=model.fingerprint,
    )


def by_formula(snr_db: float, link: LinkProfile, model: ModelInfo, quantization: str) -> Finding:
    """K* of the link that was described, by Eq. (4) and by all bytes."""
    bits_per_token = model.token_dim * codec.bits_per_value(quantization)
    paper = token_budget(snr_db, link, bits_per_token)
    framed = framed_budget(snr_db, link, model, quantization)
    values = {"token_budget": paper, "framed_token_budget": framed}
    found = (
        f"at {snr_db:g} dB {quantization} K* is {paper} by Eq. (4), {framed} with framing, "
        f"of {model.num_tokens} tokens"
    )
    if framed >= min(USEFUL_TOKENS, model.num_tokens):
        return Finding("link", "ok", found, values=values)
    remedy = _TOO_FEW + "raise bandwidth, power or period, or choose a coarser quantization"
    return Finding("link", "fail", found, remedy, values)


def by_goodput(
    seen: Goodput, link: LinkProfile, model: ModelInfo, quantization: str, claimed_db: float
) -> Finding:
    """K* that the measured goodput carries in one period, and what that says of the profile."""
    carried_bits = seen.bits_per_s * link.period_s
    carried_db = link.snr_db(carried_bits)
    measured = min(framed_budget(carried_db, link, model, quantization), model.num_tokens)
    claimed = min(framed_budget(claimed_db, link, model, quantization), model.num_tokens)
    values = {
        "token_budget": measured,
        "period_s": link.period_s,
        "carried_bits": carried_bits,
        "equivalent_snr_db": carried_db,
    }
    found = (
        f"this goodput carries {measured} of {model.num_tokens} tokens ({quantization}) in a period "
        f"of {1e3 * link.period_s:g} ms"
    )
    if measured < min(USEFUL_TOKENS, model.num_tokens):
        remedy = _TOO_FEW + "a longer period, a coarser quantization, or a better link"
        return Finding("tokens", "fail", found, remedy, values)
    if measured < claimed:
        remedy = (
            f"the link described by --snr-db and --bandwidth-hz promises {claimed}, so payloads will "
            f"be late: this link behaves like {carried_db:.1f} dB (GoodputSnr measures it while the "
            "robot runs), or lower --efficiency"
        )
        return Finding("tokens", "fail", found, remedy, values)
    return Finding("tokens", "ok", found, values=values)


def expected_period(
    tokens: int,
    seen: Goodput,
    round_trip_s: float,
    server_s: float,
    link: LinkProfile,
    model: ModelInfo,
    quantization: str,
) -> Finding:
    """How long a query of so many tokens takes: round trip, server, and transfer."""
    tokens = max(1, min(tokens, model.num_tokens))
    request_bytes = codec.request_wire_bytes(
        tokens,
        model.token_dim,
        quantization,
        num_towers=len(model.tower_dims),
        proprio_dim=model.proprio_dim,
        model_fingerprint=model.fingerprint,
    )
    transfer_s = 8.0 * request_bytes / seen.bits_per_s
    total_s = round_trip_s + server_s + transfer_s
    chunk_s = model.action_horizon * model.control_period_s
    values = {
        "tokens": tokens,
        "expected_s": total_s,
        "transfer_s": transfer_s,
        "round_trip_s": round_trip_s,
        "server_s": server_s,
        "chunk_s": chunk_s,
    }
    found = (
        f"a query of {tokens} tokens takes about {1e3 * total_s:.1f} ms ({1e3 * round_trip_s:.1f} "
        f"round trip, {1e3 * server_s:.1f} server, {1e3 * transfer_s:.1f} transfer); a chunk lasts "
        f"{1e3 * chunk_s:.0f} ms"
    )
    if total_s > chunk_s:
        remedy = "the robot will stand still between chunks: send fewer tokens, or move the server"
        return Finding("period", "fail", found, remedy, values)
    if transfer_s > link.period_s:
        remedy = f"the transfer outlasts a period of {1e3 * link.period_s:g} ms: send fewer tokens"
        return Finding("period", "note", found, remedy, values)
    return Finding("period", "ok", found, values=values)
