from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Quantization(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    QUANTIZATION_UNSPECIFIED: _ClassVar[Quantization]
    QUANTIZATION_FLOAT32: _ClassVar[Quantization]
    QUANTIZATION_FLOAT16: _ClassVar[Quantization]
    QUANTIZATION_INT8: _ClassVar[Quantization]
    QUANTIZATION_INT4: _ClassVar[Quantization]

class ImageCoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    IMAGE_CODING_UNSPECIFIED: _ClassVar[ImageCoding]
    IMAGE_CODING_JPEG: _ClassVar[ImageCoding]
    IMAGE_CODING_WEBP: _ClassVar[ImageCoding]
    IMAGE_CODING_AVIF: _ClassVar[ImageCoding]
    IMAGE_CODING_H264: _ClassVar[ImageCoding]
    IMAGE_CODING_DEEP_JSCC: _ClassVar[ImageCoding]
    IMAGE_CODING_WITT: _ClassVar[ImageCoding]
QUANTIZATION_UNSPECIFIED: Quantization
QUANTIZATION_FLOAT32: Quantization
QUANTIZATION_FLOAT16: Quantization
QUANTIZATION_INT8: Quantization
QUANTIZATION_INT4: Quantization
IMAGE_CODING_UNSPECIFIED: ImageCoding
IMAGE_CODING_JPEG: ImageCoding
IMAGE_CODING_WEBP: ImageCoding
IMAGE_CODING_AVIF: ImageCoding
IMAGE_CODING_H264: ImageCoding
IMAGE_CODING_DEEP_JSCC: ImageCoding
IMAGE_CODING_WITT: ImageCoding

class CodedImage(_message.Message):
    __slots__ = ("data", "height", "width")
    DATA_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    data: bytes
    height: int
    width: int
    def __init__(self, data: _Optional[bytes] = ..., height: _Optional[int] = ..., width: _Optional[int] = ...) -> None: ...

class CodedImages(_message.Message):
    __slots__ = ("coding", "views", "follows_step")
    CODING_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    FOLLOWS_STEP_FIELD_NUMBER: _ClassVar[int]
    coding: ImageCoding
    views: _containers.RepeatedCompositeFieldContainer[CodedImage]
    follows_step: int
    def __init__(self, coding: _Optional[_Union[ImageCoding, str]] = ..., views: _Optional[_Iterable[_Union[CodedImage, _Mapping]]] = ..., follows_step: _Optional[int] = ...) -> None: ...

class GetModelRequest(_message.Message):
    __slots__ = ("protocol_version", "model")
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    protocol_version: int
    model: str
    def __init__(self, protocol_version: _Optional[int] = ..., model: _Optional[str] = ...) -> None: ...

class GetModelResponse(_message.Message):
    __slots__ = ("protocol_version", "model_name", "model_fingerprint", "num_tokens", "token_dim", "tower_dims", "grid", "action_horizon", "action_dim", "proprio_dim", "max_prompt_tokens", "delta_actions", "control_period_s", "quantizations", "max_request_bytes", "server_version", "image_size", "image_codings", "progressive", "run_options", "edge_fingerprints")
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_NAME_FIELD_NUMBER: _ClassVar[int]
    MODEL_FINGERPRINT_FIELD_NUMBER: _ClassVar[int]
    NUM_TOKENS_FIELD_NUMBER: _ClassVar[int]
    TOKEN_DIM_FIELD_NUMBER: _ClassVar[int]
    TOWER_DIMS_FIELD_NUMBER: _ClassVar[int]
    GRID_FIELD_NUMBER: _ClassVar[int]
    ACTION_HORIZON_FIELD_NUMBER: _ClassVar[int]
    ACTION_DIM_FIELD_NUMBER: _ClassVar[int]
    PROPRIO_DIM_FIELD_NUMBER: _ClassVar[int]
    MAX_PROMPT_TOKENS_FIELD_NUMBER: _ClassVar[int]
    DELTA_ACTIONS_FIELD_NUMBER: _ClassVar[int]
    CONTROL_PERIOD_S_FIELD_NUMBER: _ClassVar[int]
    QUANTIZATIONS_FIELD_NUMBER: _ClassVar[int]
    MAX_REQUEST_BYTES_FIELD_NUMBER: _ClassVar[int]
    SERVER_VERSION_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_CODINGS_FIELD_NUMBER: _ClassVar[int]
    PROGRESSIVE_FIELD_NUMBER: _ClassVar[int]
    RUN_OPTIONS_FIELD_NUMBER: _ClassVar[int]
    EDGE_FINGERPRINTS_FIELD_NUMBER: _ClassVar[int]
    protocol_version: int
    model_name: str
    model_fingerprint: str
    num_tokens: int
    token_dim: int
    tower_dims: _containers.RepeatedScalarFieldContainer[int]
    grid: _containers.RepeatedScalarFieldContainer[int]
    action_horizon: int
    action_dim: int
    proprio_dim: int
    max_prompt_tokens: int
    delta_actions: _containers.RepeatedScalarFieldContainer[bool]
    control_period_s: float
    quantizations: _containers.RepeatedScalarFieldContainer[Quantization]
    max_request_bytes: int
    server_version: str
    image_size: _containers.RepeatedScalarFieldContainer[int]
    image_codings: _containers.RepeatedScalarFieldContainer[ImageCoding]
    progressive: bool
    run_options: _containers.RepeatedScalarFieldContainer[str]
    edge_fingerprints: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, protocol_version: _Optional[int] = ..., model_name: _Optional[str] = ..., model_fingerprint: _Optional[str] = ..., num_tokens: _Optional[int] = ..., token_dim: _Optional[int] = ..., tower_dims: _Optional[_Iterable[int]] = ..., grid: _Optional[_Iterable[int]] = ..., action_horizon: _Optional[int] = ..., action_dim: _Optional[int] = ..., proprio_dim: _Optional[int] = ..., max_prompt_tokens: _Optional[int] = ..., delta_actions: _Optional[_Iterable[bool]] = ..., control_period_s: _Optional[float] = ..., quantizations: _Optional[_Iterable[_Union[Quantization, str]]] = ..., max_request_bytes: _Optional[int] = ..., server_version: _Optional[str] = ..., image_size: _Optional[_Iterable[int]] = ..., image_codings: _Optional[_Iterable[_Union[ImageCoding, str]]] = ..., progressive: bool = ..., run_options: _Optional[_Iterable[str]] = ..., edge_fingerprints: _Optional[_Iterable[str]] = ...) -> None: ...

class InferRequest(_message.Message):
    __slots__ = ("session_id", "step", "instruction", "proprio", "payload", "model_fingerprint", "snr_db", "snr_age_s", "protocol_version", "images", "model")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    INSTRUCTION_FIELD_NUMBER: _ClassVar[int]
    PROPRIO_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    MODEL_FINGERPRINT_FIELD_NUMBER: _ClassVar[int]
    SNR_DB_FIELD_NUMBER: _ClassVar[int]
    SNR_AGE_S_FIELD_NUMBER: _ClassVar[int]
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    step: int
    instruction: str
    proprio: _containers.RepeatedScalarFieldContainer[float]
    payload: bytes
    model_fingerprint: str
    snr_db: float
    snr_age_s: float
    protocol_version: int
    images: CodedImages
    model: str
    def __init__(self, session_id: _Optional[str] = ..., step: _Optional[int] = ..., instruction: _Optional[str] = ..., proprio: _Optional[_Iterable[float]] = ..., payload: _Optional[bytes] = ..., model_fingerprint: _Optional[str] = ..., snr_db: _Optional[float] = ..., snr_age_s: _Optional[float] = ..., protocol_version: _Optional[int] = ..., images: _Optional[_Union[CodedImages, _Mapping]] = ..., model: _Optional[str] = ...) -> None: ...

class InferResponse(_message.Message):
    __slots__ = ("session_id", "step", "actions", "action_horizon", "action_dim", "tokens_used", "batch_size", "cloud_flops", "timings", "load", "model_fingerprint")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    ACTION_HORIZON_FIELD_NUMBER: _ClassVar[int]
    ACTION_DIM_FIELD_NUMBER: _ClassVar[int]
    TOKENS_USED_FIELD_NUMBER: _ClassVar[int]
    BATCH_SIZE_FIELD_NUMBER: _ClassVar[int]
    CLOUD_FLOPS_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    LOAD_FIELD_NUMBER: _ClassVar[int]
    MODEL_FINGERPRINT_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    step: int
    actions: _containers.RepeatedScalarFieldContainer[float]
    action_horizon: int
    action_dim: int
    tokens_used: int
    batch_size: int
    cloud_flops: float
    timings: ServerTimings
    load: LoadHint
    model_fingerprint: str
    def __init__(self, session_id: _Optional[str] = ..., step: _Optional[int] = ..., actions: _Optional[_Iterable[float]] = ..., action_horizon: _Optional[int] = ..., action_dim: _Optional[int] = ..., tokens_used: _Optional[int] = ..., batch_size: _Optional[int] = ..., cloud_flops: _Optional[float] = ..., timings: _Optional[_Union[ServerTimings, _Mapping]] = ..., load: _Optional[_Union[LoadHint, _Mapping]] = ..., model_fingerprint: _Optional[str] = ...) -> None: ...

class InferProgressiveRequest(_message.Message):
    __slots__ = ("head", "piece")
    HEAD_FIELD_NUMBER: _ClassVar[int]
    PIECE_FIELD_NUMBER: _ClassVar[int]
    head: InferProgressiveHead
    piece: bytes
    def __init__(self, head: _Optional[_Union[InferProgressiveHead, _Mapping]] = ..., piece: _Optional[bytes] = ...) -> None: ...

class InferProgressiveHead(_message.Message):
    __slots__ = ("request", "window_s", "min_tokens")
    REQUEST_FIELD_NUMBER: _ClassVar[int]
    WINDOW_S_FIELD_NUMBER: _ClassVar[int]
    MIN_TOKENS_FIELD_NUMBER: _ClassVar[int]
    request: InferRequest
    window_s: float
    min_tokens: int
    def __init__(self, request: _Optional[_Union[InferRequest, _Mapping]] = ..., window_s: _Optional[float] = ..., min_tokens: _Optional[int] = ...) -> None: ...

class InferProgressiveResponse(_message.Message):
    __slots__ = ("response",)
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    response: InferResponse
    def __init__(self, response: _Optional[_Union[InferResponse, _Mapping]] = ...) -> None: ...

class ServerTimings(_message.Message):
    __slots__ = ("decode_s", "queue_s", "predict_s", "total_s")
    DECODE_S_FIELD_NUMBER: _ClassVar[int]
    QUEUE_S_FIELD_NUMBER: _ClassVar[int]
    PREDICT_S_FIELD_NUMBER: _ClassVar[int]
    TOTAL_S_FIELD_NUMBER: _ClassVar[int]
    decode_s: float
    queue_s: float
    predict_s: float
    total_s: float
    def __init__(self, decode_s: _Optional[float] = ..., queue_s: _Optional[float] = ..., predict_s: _Optional[float] = ..., total_s: _Optional[float] = ...) -> None: ...

class LoadHint(_message.Message):
    __slots__ = ("queue_depth", "utilization", "suggested_tokens")
    QUEUE_DEPTH_FIELD_NUMBER: _ClassVar[int]
    UTILIZATION_FIELD_NUMBER: _ClassVar[int]
    SUGGESTED_TOKENS_FIELD_NUMBER: _ClassVar[int]
    queue_depth: int
    utilization: float
    suggested_tokens: int
    def __init__(self, queue_depth: _Optional[int] = ..., utilization: _Optional[float] = ..., suggested_tokens: _Optional[int] = ...) -> None: ...
