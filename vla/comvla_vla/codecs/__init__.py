"""Learned image codecs, the competition: pictures as analogue symbols, and vision in the cloud.

* :class:`ImageCodec`: DeepJSCC or WITT by its configuration, with power, noise and equalisation
  (:mod:`.analogue`);
* :func:`load_codec`, :func:`save_codec`: trained ones, shipped or in a folder;
* :mod:`.waveform`: what a receiver hands on to the server.

Both ends need a codec: the robot encodes, the cloud decodes. Training and curves are in
:mod:`comvla_sim.codecs`.
"""

from comvla_vla.codecs.deep_jscc import DeepJSCCConfig
from comvla_vla.codecs.files import TrainedCodec, load_codec, save_codec
from comvla_vla.codecs.image_codec import (
    CODECS,
    SMALL,
    CodecConfig,
    ImageCodec,
    Rate,
    rate,
)
from comvla_vla.codecs.witt import WITTConfig

__all__ = [
    "CODECS",
    "SMALL",
    "CodecConfig",
    "DeepJSCCConfig",
    "ImageCodec",
    "Rate",
    "TrainedCodec",
    "WITTConfig",
    "load_codec",
    "rate",
    "save_codec",
]
