"""From a payload to the bytes that cross a socket: protobuf, gRPC, HTTP/2 and, where asked, TCP/IP.

A unary call sends its message behind a 5-byte gRPC prefix in HTTP/2 DATA frames of 9 bytes each.
How a message is split is decided by the *receiver*, who advertises the largest frame and the
flow-control window. By default gRPC changes both while it runs, from round-trip measurements of
its own, and no formula is exact. With :data:`GRPC_OPTIONS` on both ends they stay put:

* a call that fits into ``WRITE_BYTES`` (128 KiB: 59 INT8 tokens of the paper's width) is cut at
  every ``HTTP2_FRAME_BYTES``, and :func:`wire_bytes` is exact;
* a longer one is handed to the socket in pieces, and a frame also ends where a piece does. That
  adds at most one frame, 9 bytes, for each piece, and most often none.

Towards a server without these options gRPC uses larger frames, and so fewer: the figure is then
above the truth by at most 9 bytes in 16 KiB. Measured with clients of grpcio 1.62 to 1.85 and
servers of 1.74 to 1.85.
"""

from __future__ import annotations

from comvla.codec.accounting import encoded_bytes
from comvla.errors import CodecError

HTTP2_FRAME_BYTES = 16_384
"""Largest DATA frame that a receiver advertises unless told otherwise (RFC 9113, 6.5.2)."""

HTTP2_END_BYTES = 9
"""The empty DATA frame by which one side of a stream of messages says that no more will come."""

WRITE_BYTES = 131_072
"""What gRPC hands to the socket at once on a new connection.

It grows on a fast link, and shrinks where such a piece takes longer than a second (gRPC's
``src/core/ext/transport/chttp2/transport/write_size_policy.h``).
"""

CALL_HEADERS_BYTES = 56
"""What a call sends besides DATA on a connection in use: HEADERS and WINDOW_UPDATE, at most.

31 where the deadline is one sent before, up to 56 where it is new. The first call of a connection
also spells out path, authority and user agent: about 260 bytes with the frames above.
"""

PART_PACKET_EVERY_BYTES = 32_768
"""A request of more than this has packets that are not full, at most one in so many bytes.

They arise where a piece that gRPC hands to the socket ends, and where the socket's buffer is full
for a moment. Each costs headers of TCP and IP, and at times those of an HTTP/2 frame.
"""

GRPC_OPTIONS: tuple[tuple[str, int], ...] = (
    ("grpc.http2.bdp_probe", 0),
    ("grpc.http2.lookahead_bytes", 8 << 20),
)
"""Channel and server options that pin frame size and flow-control window; use them on both ends.

The window of 8 MiB holds the largest message (512 float32 tokens of 2176 values are 4.3 MiB), so
that no call waits for the other end's permission to go on. A server needs grpcio 1.74 for this:
older ones apply the window to each call but not to the connection, and every 64 KiB then cost a
round trip. Clients may be older.
"""

_FRAME_HEADER_BYTES = 9
_GRPC_PREFIX_BYTES = 5
_TCP_IP_HEADER_BYTES = 52
_TAG_BYTES = 1  # of the fields of InferRequest whose number is below 16
_LONG_TAG_BYTES = 2  # of the others


def wire_bytes(message_bytes: int, *, tcp_ip: bool = False, mtu_bytes: int = 1500) -> int:
    """Bytes of the DATA frames that carry one message of a unary call, in either direction.

    Args:
        message_bytes: length of the serialised protobuf message.
        tcp_ip: count IPv4 and TCP headers too, 52 bytes (with timestamps) for each segment.
        mtu_bytes: what one IP packet holds; used with ``tcp_ip``.

    Raises:
        CodecError: negative ``message_bytes``, or an MTU that leaves no room for data.
    """
    if message_bytes < 0:
        raise CodecError(f"expected message_bytes of at least 0, got {message_bytes}")
    framed = _framed(message_bytes)
    return _with_tcp_ip(framed, mtu_bytes) if tcp_ip else framed


def request_wire_bytes(
    k: int,
    token_dim: int,
    quantization: str,
    *,
    num_towers: int = 1,
    session_id: str = "",
    step: int = 0,
    instruction: str = "",
    proprio_dim: int = 0,
    model_fingerprint: str = "",
    snr: bool = True,
    snr_age: bool = True,
    protocol_version: int = 1,
    tcp_ip: bool = False,
    mtu_bytes: int = 1500,
) -> int:
    """Bytes that a robot sends to have ``k`` tokens answered, headers included.

    Monotonic in ``k``: the largest affordable K is found by bisection, without building a payload.
    The same as :func:`wire_bytes` of the request plus :data:`CALL_HEADERS_BYTES`; the arguments
    are those of :func:`infer_request_bytes`.

    With ``tcp_ip`` it is everything that leaves the robot for this query, and never less than
    that: also the packet that acknowledges the answer, and packets that are not full
    (:data:`PART_PACKET_EVERY_BYTES`). Against a packet capture it is at most 1 % above
    (``comvla-sim bench wire``). Not counted: packets that are sent again because they were lost,
    the opening of a connection (about 600 bytes with gRPC's own), and a ping of 69 bytes on a
    connection that was silent for 10 s.

    Raises:
        CodecError: arguments out of range, see :func:`encoded_bytes`.
    """
    message = infer_request_bytes(
        encoded_bytes(k, token_dim, quantization, num_towers=num_towers),
        session_id=session_id,
        step=step,
        instruction=instruction,
        proprio_dim=proprio_dim,
        model_fingerprint=model_fingerprint,
        snr=snr,
        snr_age=snr_age,
        protocol_version=protocol_version,
    )
    framed = _framed(message) + CALL_HEADERS_BYTES
    if not tcp_ip:
        return framed
    part_packets = framed // PART_PACKET_EVERY_BYTES
    overhead = part_packets * (_FRAME_HEADER_BYTES + _TCP_IP_HEADER_BYTES) + _TCP_IP_HEADER_BYTES
    return _with_tcp_ip(framed, mtu_bytes) + overhead


def infer_request_bytes(
    payload_length: int,
    *,
    session_id: str = "",
    step: int = 0,
    instruction: str = "",
    proprio_dim: int = 0,
    model_fingerprint: str = "",
    snr: bool = True,
    snr_age: bool = True,
    protocol_version: int = 1,
    images_length: int = 0,
    model: str = "",
) -> int:
    """Exact serialised length of an ``InferRequest``, without building it.

    Args:
        payload_length: bytes in its ``payload`` field, see :func:`encoded_bytes`.
        session_id: as in the request.
        step: as in the request.
        instruction: as in the request.
        proprio_dim: P, number of proprioceptive values, whatever they are.
        model_fingerprint: as in the request.
        snr: whether ``snr_db`` is set, even to 0.
        snr_age: whether ``snr_age_s`` is set, even to 0.
        protocol_version: as in the request.
        images_length: bytes of its ``images`` message, see :func:`comvla.images.images_bytes`; 0
            where tokens are sent.
        model: as in the request.

    Raises:
        CodecError: a negative number.
    """
    if min(payload_length, step, proprio_dim, protocol_version, images_length) < 0:
        raise CodecError(
            "expected payload_length, step, proprio_dim, protocol_version and images_length of at "
            f"least 0, got {payload_length}, {step}, {proprio_dim}, {protocol_version} and "
            f"{images_length}"
        )
    texts = (session_id, instruction, model_fingerprint)
    lengths = [len(text.encode()) for text in texts]
    lengths += [4 * proprio_dim, payload_length, images_length]
    total = sum(_TAG_BYTES + varint_bytes(length) + length for length in lengths if length)
    total += sum(_TAG_BYTES + varint_bytes(number) for number in (step, protocol_version) if number)
    if named := len(model.encode()):
        total += _LONG_TAG_BYTES + varint_bytes(named) + named
    return total + (_TAG_BYTES + 4) * (snr + snr_age)


def _framed(message_bytes: int) -> int:
    body = message_bytes + _GRPC_PREFIX_BYTES
    return body + _FRAME_HEADER_BYTES * -(-body // HTTP2_FRAME_BYTES)


def _with_tcp_ip(stream_bytes: int, mtu_bytes: int) -> int:
    room = mtu_bytes - _TCP_IP_HEADER_BYTES
    if room < 1:
        raise CodecError(f"expected an MTU above {_TCP_IP_HEADER_BYTES} bytes, got {mtu_bytes}")
    return stream_bytes + _TCP_IP_HEADER_BYTES * -(-stream_bytes // room)


def varint_bytes(number: int) -> int:
    """Bytes of a whole number at least 0 in protobuf's variable-length form."""
    return max(1, -(-number.bit_length() // 7))
