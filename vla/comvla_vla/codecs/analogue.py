"""Analogue symbols over one control period of a fading link: power, noise, equalisation.

A learned codec sends its latent as it is: two real values are one complex symbol s, and a period
sees one complex gain h for all k symbols of a picture,

    y = h s + n,    n ~ CN(0, N0),    SNR = P |h|² / N0,

with P the mean power of a symbol. N0 is the noise power of a *complex* symbol: each of its two
real parts has N0 / 2. (Giving every real part N0 would be 3 dB less SNR than it says, and giving
it N0 / 4 would be 3 dB more: both are seen in public code.)
"""

from __future__ import annotations

import torch
from torch import Tensor

from comvla.errors import CodecError


def to_symbols(latent: Tensor) -> Tensor:
    """Real values (n, ...) as complex symbols (n, k): neighbours in memory make a pair.

    Raises:
        CodecError: an odd number of values.
    """
    flat = latent.flatten(1).float()
    if flat.shape[1] % 2:
        raise CodecError(f"a latent needs an even number of values, this has {flat.shape[1]}")
    return torch.view_as_complex(flat.reshape(len(flat), -1, 2))


def to_latent(symbols: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Complex symbols (n, k) back as real values (n, *shape)."""
    return torch.view_as_real(symbols).reshape(len(symbols), *shape)


def normalise_power(symbols: Tensor, power: float = 1.0) -> Tensor:
    """√(kP) · z / ‖z‖ for each picture: its k symbols then have mean power P exactly.

    Args:
        symbols: (n, k) complex.
        power: P.

    Returns:
        (n, k) complex. A picture of all zeros stays so: it is silence.
    """
    energy = torch.view_as_real(symbols).square().sum((-2, -1))
    scale = (symbols.shape[-1] * power / energy.clamp_min(1e-20)).sqrt()
    return symbols * scale[..., None]


def noise_power(snr_db: Tensor, power: float = 1.0) -> Tensor:
    """N0 of a complex symbol for an SNR in dB at gain 1."""
    return power * 10.0 ** (-snr_db / 10)


def instantaneous_snr_db(gain: Tensor, noise: Tensor, power: float = 1.0) -> Tensor:
    """SNR in dB of a period with gain h and noise power N0."""
    return 10 * torch.log10(power * gain.abs().square() / noise)


def transmit(
    symbols: Tensor, gain: Tensor, noise: Tensor, generator: torch.Generator | None = None
) -> Tensor:
    """What arrives: y = h s + n.

    Args:
        symbols: (n, k) complex.
        gain: (n,) complex, one h for each picture.
        noise: (n,) N0, noise power of a complex symbol.
        generator: of the noise.

    Returns:
        (n, k) complex64.
    """
    parts = torch.randn((*symbols.shape, 2), generator=generator)
    noise_of_part = (noise / 2).sqrt()  # N0 is shared between the real and the imaginary part
    return gain[:, None] * symbols + torch.view_as_complex(parts) * noise_of_part[:, None]


def equalise_mmse(received: Tensor, gain: Tensor, noise: Tensor, power: float = 1.0) -> Tensor:
    """The linear estimate of s with least mean square error: h* y / (|h|² + N0 / P).

    Its error is P N0 / (P |h|² + N0) for each symbol. A gain of 0 gives 0.

    Args:
        received: (n, k) complex.
        gain: (n,) complex, known to the receiver (from pilots).
        noise: (n,) N0.
        power: P.
    """
    weight = gain.conj() / (gain.abs().square() + noise / power)
    return received * weight[:, None]
