"""What can be wrong with an evaluation that was asked for."""

from comvla.errors import ComVLAError


class EvaluationError(ComVLAError, ValueError):
    """An evaluation that cannot be run or resumed as asked; the message says what to change."""


class UnansweredError(EvaluationError):
    """A query that the server left without an answer."""


class NothingMeasuredError(EvaluationError):
    """Nothing may be measured, and no episode is there."""
