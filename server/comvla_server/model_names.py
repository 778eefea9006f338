"""``--model``: one checkpoint without a name, or several, each NAME=SOURCE."""

from __future__ import annotations

import re

from comvla_server.setting_fields import SettingsError

UNNAMED = ""
"""Name of the model of a server that serves one and calls it nothing."""

MOST_MODELS = 16
"""Models of one server at most: each is a label in its metrics."""

_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}"
_NAMED = re.compile(rf"(?P<name>{_NAME})=(?P<source>.+)", re.DOTALL)
_FORGOTTEN = re.compile(rf"{_NAME}=")
_BETWEEN = re.compile(rf",(?={_NAME}=)")


def parse_models(text: str) -> dict[str, str]:
    """Checkpoints by the names under which robots ask for them, the default first.

    Args:
        text: ``SOURCE``, or ``NAME=SOURCE`` once or more with commas between. A folder whose own name
            looks so is written ``./a=b``.

    Raises:
        SettingsError: a name twice, names and none mixed, or too many.
    """
    parts = [_NAMED.fullmatch(part) for part in _BETWEEN.split(text)]
    if parts == [None] and text.strip() and not _FORGOTTEN.fullmatch(text):
        return {UNNAMED: text}
    models: dict[str, str] = {}
    for part in parts:
        if part is None or part["name"] in models:
            raise SettingsError(
                f"model must be one SOURCE, or NAME=SOURCE for each of several, every name once, got "
                f"{text!r}: e.g. --model pick=/models/pick --model place=/models/place"
            )
        models[part["name"]] = part["source"]
    if len(models) > MOST_MODELS:
        raise SettingsError(
            f"model must name at most {MOST_MODELS} models, got {len(models)}: start another server"
        )
    return models


def join_models(parts: list[str]) -> str:
    """What was given one by one, as one text that :func:`parse_models` reads."""
    return ",".join(parts)
