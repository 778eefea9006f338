"""One episode in closed loop: world, client, transport, and what is measured on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from comvla_client import ComVLAClient, StepReport
from comvla_client.edge import EdgeModel
from comvla_client.transport import GrpcTransport
from comvla_client.transport_protocol import Transport
from comvla_client.uplink import UplinkForm
from comvla_sim.experiments.errors import EvaluationError, UnansweredError
from comvla_sim.experiments.layouts import evaluation_layout, foreign_layout
from comvla_sim.experiments.link_case import channel_seed
from comvla_sim.experiments.methods import find_method
from comvla_sim.experiments.observing import ObservedEdge, SelectionStatistics
from comvla_sim.experiments.over_link import EpisodeLink
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.link import LinkRecord
from comvla_sim.worlds.base import Task, World

Pictures = npt.NDArray[np.uint8]

OnQuery: TypeAlias = Callable[[int, StepReport, LinkRecord | None], None]

# Simulated time stands still while the policy thinks; a slow machine must not change results, nor one that was
# suspended meanwhile. A server of somebody else's may hang.
_DEADLINE_S = 30 * 86_400.0
_SERVER_DEADLINE_S = 600.0
CONNECT_TIMEOUT_S = 15.0
"""Longest that an episode waits for its server."""


@dataclass(frozen=True)
class Roles:
    """Who plays which part in an episode under its condition.

    Attributes:
        task: the one that counts as success.
        other: a task about another fixture of the same table; None where there is none.
        spoken: the task whose instruction the robot is given.
        heard: the task whose instruction selects tokens instead of the spoken one; None: the same.
    """

    task: Task
    other: Task | None
    spoken: Task
    heard: Task | None


def cast(world: World, spec: EpisodeSpec, layout_seed: int) -> Roles:
    """Who plays which part; the layout must be on the table.

    Raises:
        EvaluationError: the condition needs another fixture and the table has none.
    """
    task = world.find_task(spec.task)
    others = [t for t in world.possible_tasks() if t.fixture != task.fixture]
    other: Task | None = None
    if others:
        # Drawn from the layout and the task alone, so it is the same for every method and K.
        random = np.random.RandomState([layout_seed, world.tasks.index(task)])
        other = others[random.randint(len(others))]
    if spec.condition in ("wrong_instruction", "wrong_selection") and other is None:
        raise EvaluationError(
            f"--condition {spec.condition} names another fixture on the table, and this world "
            "shows one only: leave the condition out, or use --world tabletop"
        )
    named_wrongly = spec.condition == "wrong_instruction"
    return Roles(
        task=task,
        other=other,
        spoken=other if named_wrongly and other is not None else task,
        heard=other if spec.condition == "wrong_selection" else None,
    )


def expert_pictures(world: World, task: str, layout_seed: int, every: int) -> list[Pictures]:
    """What the cameras saw while the expert did ``task`` elsewhere, one entry each ``every`` steps.

    The world is reset to that layout and left wherever the expert got.
    """
    observation, _ = world.reset(seed=layout_seed, options={"task": task})
    pictures = [observation["images"]]
    for step in range(1, world.max_episode_steps + 1):
        world.advance(world.expert_action())
        done = world.successes()[task]
        if step % every == 0 or done:
            pictures.append(world.observe()["images"])
        if done:
            break
    return pictures


class _Totals:
    """Sums over an episode's queries."""

    def __init__(self) -> None:
        self.queries = 0
        self.fallbacks = 0
        self.payload_bytes = 0
        self.encoded_bytes = 0
        self.framed_bytes = 0
        self.edge_flops = 0.0
        self.cloud_flops = 0.0

    def add(self, report: StepReport) -> None:
        self.queries += 1
        self.fallbacks += report.fallback_reason is not None
        self.payload_bytes += report.payload_bytes
        self.encoded_bytes += report.encoded_bytes
        self.framed_bytes += report.framed_bytes
        self.edge_flops += report.edge_flops
        self.cloud_flops += report.cloud_flops


def _link(
    target: Transport | str, spec: EpisodeSpec, seed: int, world: World
) -> EpisodeLink | None:
    if spec.link is None:
        return None
    transport = GrpcTransport(target) if isinstance(target, str) else target
    return EpisodeLink(spec.link, seed, world.max_episode_steps, transport)


def _client(
    target: EpisodeLink | Transport | str,
    edge: EdgeModel,
    form: UplinkForm,
    spec: EpisodeSpec,
    settings: EvalSettings,
    seed: int,
) -> ComVLAClient:
    # Pictures are as large as they are; a number would limit their bytes.
    budget: Any = spec.k if form.in_pieces else "paper"
    options: dict[str, Any] = {}
    if isinstance(target, EpisodeLink):
        case = target.case
        if budget is None or find_method(spec.method).decides_itself:
            budget = case.budget
        options = {"link": case.profile(), "sending": target.sending()}
        target = target.transport
    return ComVLAClient(
        target,
        edge=edge,
        uplink=form,
        budget=budget,
        quantization=settings.quantization,
        deadline_s=_SERVER_DEADLINE_S if settings.target else _DEADLINE_S,
        connect_timeout_s=CONNECT_TIMEOUT_S,
        seed=seed,
        **options,
    )


def run_episode(
    world: World,
    edge: EdgeModel,
    target: Transport | str,
    spec: EpisodeSpec,
    settings: EvalSettings,
    on_query: OnQuery = lambda step, report, record: None,
) -> dict[str, Any]:
    """Runs one episode and returns what it measured, as plain JSON values.

    Conditions: ``normal``; ``blind`` shows the pictures of an expert that does the same task in
    another layout; ``wrong_instruction`` speaks the instruction of another fixture on the table,
    and the episode then ends when *that* task is done; ``wrong_selection`` selects tokens by
    another fixture's instruction and sends the right one.

    Args:
        world: is reset here.
        edge: the robot's half.
        target: a transport or ``host:port``.
        spec: which episode.
        settings: of the evaluation.
        on_query: called after each query with the control period in which it was made, the
            client's account, and the link's, where there is one and something was sent.

    Raises:
        EvaluationError: the condition is impossible here.
        UnansweredError: the server left a query without an answer.
        ObservationError, InstructionError, HandshakeError: world, policy and server do not fit.
    """
    started = time.perf_counter()
    layout_seed = evaluation_layout(settings.seed, spec.episode)
    film: list[Pictures] = []
    if spec.condition == "blind":
        elsewhere = foreign_layout(settings.seed, spec.episode)
        film = expert_pictures(world, spec.task, elsewhere, edge.info.action_horizon)
    observation, _ = world.reset(seed=layout_seed, options={"task": spec.task})
    roles = cast(world, spec, layout_seed)
    method = find_method(spec.method)
    form = method.form()
    observed = ObservedEdge(
        edge,
        roles.heard.instruction if roles.heard else None,
        look=None if film or not form.in_pieces else lambda: list(world.observe()["images"]),
    )

    def look(query: int) -> list[Pictures]:
        if film:
            return list(film[min(query, len(film) - 1)])
        if form.in_pieces:  # the edge half takes its own; these are there to be checked
            return list(observation["images"])
        return list(world.observe()["images"] if query else observation["images"])

    compared = roles.other if spec.condition == "normal" else None
    statistics = SelectionStatistics(
        observed, method.selector(), compared.instruction if compared else None, layout_seed
    )
    totals = _Totals()
    link = _link(target, spec, channel_seed(layout_seed, world.tasks.index(roles.task)), world)
    success = other_success = ended = False
    steps = 0
    with _client(link or target, observed, form, spec, settings, layout_seed) as client:
        while steps < world.max_episode_steps and not ended:
            proprio = world.proprio()
            shown = {"images": look(totals.queries), "proprio": proprio}
            hold, asked = client.hold_action, 0 if link is None else link.period
            chunk = client.step(
                shown, roles.spoken.instruction, None if link is None else link.reading()
            )
            report = chunk.report
            totals.add(report)
            record = None if link is None else link.account(report)
            if report.source == "cloud":
                kept = report.positions[: report.tokens_used]
                statistics.add(kept, None if film else world, roles.spoken, proprio)
            elif link is None or report.fallback_reason not in ("no_link", "deadline"):
                raise UnansweredError(
                    f"the policy gave no answer ({report.fallback_reason}: {report.detail}): check "
                    "the server, then run the same command again"
                )
            on_query(steps, report, record)
            # Without an answer the robot executes the rest of the last chunk, then holds for one
            # period and asks again, as ``act`` does. While an answer is late it holds, too.
            actions = world.from_policy(chunk.actions)[: max(1, chunk.planned)]
            waited = 0 if link is None else link.period - asked
            if waited:
                waiting = world.from_policy(np.tile(hold, (waited, 1)))
                actions = np.concatenate([waiting, actions])
            for number, action in enumerate(actions[: world.max_episode_steps - steps]):
                world.advance(action)
                steps += 1
                if link is not None:
                    link.use.held_periods += number < waited or not chunk.planned
                    if number >= waited:
                        link.advance()
                fulfilled = world.successes()
                success |= fulfilled[roles.task.name]
                other_success |= roles.other is not None and fulfilled[roles.other.name]
                ended = fulfilled[roles.spoken.name]
                if ended:
                    break
    return {
        "layout_seed": layout_seed,
        "instruction": roles.task.instruction,
        "spoken": roles.spoken.instruction,
        "heard": (roles.heard or roles.spoken).instruction,
        "other_task": roles.other.name if roles.other else None,
        "success": success,
        "other_success": other_success if roles.other else None,
        "steps": steps,
        **vars(totals),
        "selection": statistics.as_dict(),
        "channel_seed": None if link is None else link.seed,
        "link_use": None if link is None else vars(link.use),
        "wall_s": round(time.perf_counter() - started, 3),
    }
