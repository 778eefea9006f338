"""Every error of this project derives from :class:`ComVLAError`, so one ``except`` catches all."""


class ComVLAError(Exception):
    """Base of all errors raised on purpose by ComVLA.

    The message names what was expected, what came, and the remedy.
    """


class CodecError(ComVLAError, ValueError):
    """A payload that is not what the token codec writes, or a picture that is not what its coding writes."""


class KeyFrameNeededError(ComVLAError):
    """A picture that builds on one which is not held here: the next has to be a key frame."""


class CheckpointError(ComVLAError):
    """A checkpoint that is missing, damaged, foreign or incomplete."""


class InstructionError(ComVLAError, ValueError):
    """An instruction that is empty, too long for the prompt, or made of words never seen."""


class ObservationError(ComVLAError, ValueError):
    """An observation (images, proprioception) of the wrong type, shape, dtype or range."""


class LinkError(ComVLAError, ValueError):
    """A link profile or a reported SNR that makes no sense."""


class HandshakeError(ComVLAError):
    """Robot and server differ in model or protocol; raised before the robot moves."""


class ModelChangedError(HandshakeError):
    """The server runs another model by now: make a new client, with the edge half of that model."""


class DependencyError(ComVLAError, ImportError):
    """An optional part (simulator, GL library, torch) is missing; the message says what to do."""
