"""The messages of tutelage.proto, from its compiled descriptor.

Code that protoc generates for Python is tied to a range of protobuf versions; the descriptor is not. It is compiled here by

    python -m grpc_tools.protoc -I. --descriptor_set_out=tutelage.binpb tutelage.proto

and a test compares it with tutelage.proto.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any

from tutelage.errors import MissingExtraError

SERVICE = "tutelage.sgc.v1.Gateway"


def descriptor() -> bytes:
    """The compiled tutelage.proto, a serialized FileDescriptorSet."""
    return (resources.files(__package__) / "tutelage.binpb").read_bytes()


@cache
def messages() -> dict[str, Any]:
    """Classes of messages by name, such as `messages()["PublishRequest"]`.

    Raises:
        MissingExtraError: protobuf is not installed.
    """
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise MissingExtraError("protobuf", "grpc") from None
    files = descriptor_pb2.FileDescriptorSet.FromString(descriptor())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    file = pool.FindFileByName("tutelage.proto")
    return {name: message_factory.GetMessageClass(kind) for name, kind in file.message_types_by_name.items()}


@cache
def methods() -> dict[str, tuple[bool, bool, Any, Any]]:
    """By name: does the client stream, does the server, class of requests, class of responses."""
    from google.protobuf import descriptor_pb2

    (service,) = descriptor_pb2.FileDescriptorSet.FromString(descriptor()).file[0].service
    classes = messages()
    return {
        method.name: (
            method.client_streaming,
            method.server_streaming,
            classes[method.input_type.rpartition(".")[2]],
            classes[method.output_type.rpartition(".")[2]],
        )
        for method in service.method
    }
