"""Coded pictures, for a robot that lets the cloud see: what crosses the link in place of tokens.

* :data:`IMAGE_CODINGS`: names of the codings that the contract knows;
* :mod:`.stills`: JPEG, WebP and AVIF files (needs Pillow);
* :mod:`.video`: H.264 over time (needs PyAV);
* :func:`images_bytes`: the size of the request's field, without building it.

Importing this package needs neither: codecs are imported where a picture is coded.
"""

from comvla.images.codings import (
    IMAGE_CODINGS,
    MAX_VIEW_PIXELS,
    coding_name,
    coding_number,
    images_bytes,
    most_data_bytes,
    picture_bytes,
)

__all__ = [
    "IMAGE_CODINGS",
    "MAX_VIEW_PIXELS",
    "coding_name",
    "coding_number",
    "images_bytes",
    "most_data_bytes",
    "picture_bytes",
]
