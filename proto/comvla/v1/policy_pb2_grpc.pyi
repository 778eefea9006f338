"""Types of the generated gRPC classes, for both of gRPC's forms. Written by hand: see policy.proto.

Building a stub from a ``grpc.Channel`` gives calls that block, from a ``grpc.aio.Channel`` calls to
await; a servicer may define its methods either way.
"""

from collections.abc import Awaitable
from typing import Any, Generic, TypeAlias, overload

import grpc
import grpc.aio
from typing_extensions import TypeVar

from comvla.v1 import policy_pb2 as pb

_GetModel: TypeAlias = grpc.UnaryUnaryMultiCallable[pb.GetModelRequest, pb.GetModelResponse]
_Infer: TypeAlias = grpc.UnaryUnaryMultiCallable[pb.InferRequest, pb.InferResponse]
_Progressive: TypeAlias = grpc.StreamUnaryMultiCallable[
    pb.InferProgressiveRequest, pb.InferProgressiveResponse
]
_AioGetModel: TypeAlias = grpc.aio.UnaryUnaryMultiCallable[pb.GetModelRequest, pb.GetModelResponse]
_AioInfer: TypeAlias = grpc.aio.UnaryUnaryMultiCallable[pb.InferRequest, pb.InferResponse]
_AioProgressive: TypeAlias = grpc.aio.StreamUnaryMultiCallable[
    pb.InferProgressiveRequest, pb.InferProgressiveResponse
]

_G = TypeVar("_G", default=_GetModel)
_I = TypeVar("_I", default=_Infer)
_P = TypeVar("_P", default=_Progressive)

class PolicyServiceStub(Generic[_G, _I, _P]):
    GetModel: _G
    Infer: _I
    InferProgressive: _P
    @overload
    def __init__(
        self: PolicyServiceStub[_GetModel, _Infer, _Progressive], channel: grpc.Channel
    ) -> None: ...
    @overload
    def __init__(
        self: PolicyServiceStub[_AioGetModel, _AioInfer, _AioProgressive], channel: grpc.aio.Channel
    ) -> None: ...

# Stands for both contexts at once, so that a servicer may declare the one that it is served with.
class _ServicerContext(grpc.ServicerContext, grpc.aio.ServicerContext[Any, Any]): ...

class PolicyServiceServicer:
    def GetModel(
        self, request: pb.GetModelRequest, context: _ServicerContext
    ) -> pb.GetModelResponse | Awaitable[pb.GetModelResponse]: ...
    def Infer(
        self, request: pb.InferRequest, context: _ServicerContext
    ) -> pb.InferResponse | Awaitable[pb.InferResponse]: ...
    def InferProgressive(
        self, request_iterator: Any, context: _ServicerContext
    ) -> pb.InferProgressiveResponse | Awaitable[pb.InferProgressiveResponse]: ...

def add_PolicyServiceServicer_to_server(
    servicer: PolicyServiceServicer, server: grpc.Server | grpc.aio.Server
) -> None: ...

class PolicyService:
    @staticmethod
    def GetModel(request: pb.GetModelRequest, target: str, *args: Any, **kwargs: Any) -> Any: ...
    @staticmethod
    def Infer(request: pb.InferRequest, target: str, *args: Any, **kwargs: Any) -> Any: ...
    @staticmethod
    def InferProgressive(request_iterator: Any, target: str, *args: Any, **kwargs: Any) -> Any: ...
