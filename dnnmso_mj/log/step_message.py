"""The log's `dnnmso.Step` message: its schema, and rows of doubles to and from its wire format.

Every message of a log has the same fields of the same widths, so its protobuf bytes are a packed
record: constant tags and lengths, little-endian doubles at fixed offsets. A NumPy structured type
over those bytes encodes and decodes thousands of messages at once. Messages of other writers,
which may leave out zeros or order fields otherwise, go through protobuf's own parser.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from dnnmso_mj.log import limits
from dnnmso_mj.trace import FLAGS, SCALARS, StepLayout

Array = np.ndarray

SCHEMA_NAME = "dnnmso.Step"
_VARINT, _DOUBLE, _BYTES = 0, 1, 2  # protobuf wire types of flags, scalars, packed vectors


def schema() -> FileDescriptorSet:
    """The schema of `dnnmso.Step`; field numbers are places in `StepLayout.widths`, from 1."""
    files = FileDescriptorSet()
    file = files.file.add(name="dnnmso/step.proto", package="dnnmso", syntax="proto3")
    step = file.message_type.add(name="Step")
    for number, name in enumerate(StepLayout(1, 1).widths, start=1):
        repeated = name not in SCALARS and name not in FLAGS
        step.field.add(
            name=name,
            number=number,
            type=FieldDescriptorProto.TYPE_BOOL
            if name in FLAGS
            else FieldDescriptorProto.TYPE_DOUBLE,
            label=FieldDescriptorProto.LABEL_REPEATED
            if repeated
            else FieldDescriptorProto.LABEL_OPTIONAL,
        )
    return files


def check_schema(data: bytes) -> None:
    """Compare a log's schema with this version's.

    Raises:
        ValueError: it is not a FileDescriptorSet, or its fields are not those of `dnnmso.Step`.
    """
    try:
        found, expected = (
            {
                (field.name, field.number, field.type, field.label)
                for file in files.file
                for message in file.message_type
                if f"{file.package}.{message.name}" == SCHEMA_NAME
                for field in message.field
            }
            for files in (FileDescriptorSet.FromString(data), schema())
        )
    except DecodeError as error:
        raise ValueError(f"the schema of {SCHEMA_NAME} is no protobuf FileDescriptorSet") from error
    differing = sorted({str(name) for name, *_ in found ^ expected})  # bytes where damaged
    if differing:
        raise ValueError(
            f"the fields of {SCHEMA_NAME} differ from this version's in {', '.join(differing)}"
        )


class StepFormat:
    """Rows of `StepLayout.width` doubles to and from protobuf messages of one size.

    Args:
        layout: names and widths of the fields; a field of width 0 is absent from the message.
    """

    def __init__(self, layout: StepLayout) -> None:
        self.layout = layout
        self.odd = 0  # messages that were packed otherwise and decoded one by one
        template = bytearray()
        offsets: list[int] = []
        values = np.zeros(0, dtype=bool)  # which bytes of a message hold numbers
        for number, (name, width) in enumerate(layout.widths.items(), start=1):
            if width:
                prefix, size = _prefix(name, number, width)
                offsets.append(len(template) + len(prefix))
                template += prefix + bytes(size)
                values = np.append(values, [False] * len(prefix) + [True] * size)
        self._template = np.frombuffer(bytes(template), dtype=np.uint8)
        self._constant = np.flatnonzero(~values)
        # The same fields twice, so that NumPy copies all of them in one assignment.
        widths = {name: width for name, width in layout.widths.items() if width}
        self._record = np.dtype(
            {
                "names": list(widths),
                "formats": [_value_type(name, width) for name, width in widths.items()],
                "offsets": offsets,
                "itemsize": len(template),
            }
        )
        self._row = np.dtype([(name, *_row_type(name, width)) for name, width in widths.items()])

    @property
    def size(self) -> int:
        """Bytes of one message."""
        return len(self._template)

    def encode(self, rows: Array) -> Array:
        """Rows (N, width), flags 0 or 1, as N messages: their bytes, (N, size)."""
        wire = np.empty((len(rows), self.size), dtype=np.uint8)
        wire[:] = self._template
        wire.view(self._record)[:, 0] = np.ascontiguousarray(rows).view(self._row)[:, 0]
        return wire

    def decode(self, messages: Array, first: int = 0) -> Array:
        """Messages of one size as rows (N, width).

        Args:
            messages: their bytes, (N, size).
            first: the number of the first of them, for errors.

        Raises:
            ValueError: a message is no `dnnmso.Step`, or its vectors have other widths.
        """
        rows = np.empty((len(messages), self.layout.width))
        if self._are_ours(messages):
            rows.view(self._row)[:, 0] = messages.view(self._record)[:, 0]
        else:
            self.odd += len(messages)
            for k, message in enumerate(messages):
                rows[k] = self._parse(message.tobytes(), first + k)
        return rows

    def _are_ours(self, messages: Array) -> bool:
        """Whether all are packed our way."""
        if messages.shape[1] != self.size:
            return False
        if (messages[:, self._constant] != self._template[self._constant]).any():
            return False
        records = messages.view(self._record)[:, 0]
        return not any((records[name] > 1).any() for name in FLAGS)

    def _parse(self, data: bytes, index: int) -> Array:
        message = _parsed(data, index)
        values: list[float] = []
        for name, width in self.layout.widths.items():
            value = getattr(message, name)
            entries = [value] if name in SCALARS or name in FLAGS else list(value)
            if len(entries) != width:
                raise ValueError(
                    f"message {index} has {len(entries)} entries in {name}; expected {width}"
                )
            values += entries
        return np.array(values, dtype=float)


def layout_of(message: bytes) -> StepLayout:
    """The layout of a log, from the widths in its first message.

    Raises:
        ValueError: the bytes are no `dnnmso.Step`, or one without a joint or with far too many.
    """
    first = _parsed(message, 0)
    if not first.q:
        raise ValueError("message 0 has no joint angle in q; expected one a joint")
    joints, layers = len(first.q), len(first.weight_norm)
    if joints > limits.JOINTS or layers > limits.LAYERS:
        raise ValueError(
            f"message 0 has {joints} joints and {layers} layers; allowed: {limits.JOINTS} and "
            f"{limits.LAYERS}"
        )
    return StepLayout(n_joints=joints, n_layers=layers)


def _message_class() -> type[Message]:
    pool = DescriptorPool()
    for file in schema().file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(SCHEMA_NAME))


_STEP = _message_class()


def _parsed(data: bytes, index: int) -> Any:
    try:
        return _STEP.FromString(data)
    except DecodeError as error:
        raise ValueError(f"message {index} is no {SCHEMA_NAME}") from error


def _prefix(name: str, number: int, width: int) -> tuple[bytes, int]:
    """The constant bytes before a field's value, and the bytes of the value."""
    if name in FLAGS:
        return _varint(number << 3 | _VARINT), 1
    if name in SCALARS:
        return _varint(number << 3 | _DOUBLE), 8
    return _varint(number << 3 | _BYTES) + _varint(8 * width), 8 * width


def _varint(value: int) -> bytes:
    """Protobuf's base-128 number: seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _value_type(name: str, width: int) -> Any:
    if name in FLAGS:
        return np.uint8
    return "<f8" if name in SCALARS else ("<f8", (width,))


def _row_type(name: str, width: int) -> Any:
    return ("f8",) if name in SCALARS or name in FLAGS else ("f8", (width,))
