"""What it all means: the paper's claims, and what came out here, each in a few words that follow from the numbers."""

from __future__ import annotations

from comvla_sim.paper import cost_claims, link_claims, success_claims
from comvla_sim.paper.claim import Claim
from comvla_sim.paper.results import Results
from comvla_sim.report.tables import Table


def table(results: Results) -> Table:
    """All claims with a verdict each."""
    return Table(
        "The paper's claims",
        "In its words or close to them, with what came out here. “Agrees” is about this world and this policy: it "
        "says that "
        "the mechanism works here and that no difference from the paper could be shown, not that its numbers were "
        "reproduced.",
        ("claim", "here", "verdict"),
        tuple((claim, here, verdict.text) for claim, here, verdict in claims(results)),
    )


def claims(results: Results) -> list[Claim]:
    """Those that the measured parts say something about."""
    made = (
        success_claims.cheap(results),
        cost_claims.size(results),
        cost_claims.operations(),
        success_claims.against_random(results),
        success_claims.against_soft(results),
        success_claims.int8(results),
        success_claims.int4(results),
        success_claims.int4_reason(results),
        link_claims.fading(results),
        link_claims.stale(results),
        cost_claims.latency(),
        success_claims.codecs(results),
        success_claims.pictures(results),
    )
    return [claim for claim in made if claim is not None]
