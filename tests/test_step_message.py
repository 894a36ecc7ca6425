"""Rows of doubles against protobuf's own encoder and parser."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from log_samples import LAYOUT, rows

from dnnmso_mj.log.step_message import SCHEMA_NAME, StepFormat, check_schema, layout_of, schema
from dnnmso_mj.trace import FLAGS, SCALARS, StepLayout


def parser(files: FileDescriptorSet) -> Any:
    pool = DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(SCHEMA_NAME))


STEP = parser(schema())


def as_message(row: np.ndarray, layout: StepLayout, step: Any = STEP) -> Any:
    """The row as a protobuf message, set field by field."""
    message = step()
    for name, where in layout.slices.items():
        values = row[where].tolist()
        if name in FLAGS:
            setattr(message, name, bool(values[0]))
        elif name in SCALARS:
            setattr(message, name, values[0])
        else:
            getattr(message, name).extend(values)
    return message


@st.composite
def layouts_and_rows(draw: st.DrawFn) -> tuple[StepLayout, np.ndarray]:
    layout = StepLayout(draw(st.integers(1, 7)), draw(st.integers(0, 4)))
    shape = (draw(st.integers(1, 3)), layout.width)
    data = draw(hnp.arrays(float, shape, elements=st.floats(width=64)))
    for name in FLAGS:
        data[:, layout.slices[name]] = data[:, layout.slices[name]] > 0.0
    return layout, data


def assert_same_bits(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_array_equal(a.view(np.uint64), b.view(np.uint64))


def as_bytes(message: bytes) -> np.ndarray:
    """One message as `decode` takes them."""
    return np.frombuffer(message, dtype=np.uint8).reshape(1, -1)


@given(layouts_and_rows())
def test_protobuf_parses_encoded_rows_to_the_same_numbers(case):
    layout, data = case
    for row, message in zip(data, StepFormat(layout).encode(data), strict=True):
        parsed = STEP.FromString(message.tobytes())
        values: list[float] = []
        for name in layout.widths:
            value = getattr(parsed, name)
            values += [value] if name in SCALARS or name in FLAGS else value
        assert_same_bits(np.array(values, dtype=float), row)


@given(layouts_and_rows())
def test_messages_of_another_protobuf_writer_decode_to_the_same_numbers(case):
    layout, data = case  # zeros are left out by that writer, so sizes differ
    for row in data:
        message = as_message(row, layout).SerializeToString()
        assert_same_bits(StepFormat(layout).decode(as_bytes(message)), row[None])


@given(layouts_and_rows())
def test_decode_inverts_encode_bit_for_bit(case):
    layout, data = case
    wire = StepFormat(layout)
    messages = wire.encode(data)
    assert messages.shape == (len(data), wire.size)
    assert_same_bits(wire.decode(messages), data)
    assert layout_of(messages[0].tobytes()) == layout


def test_unpacked_vectors_decode_too():
    files = schema()
    for field in files.file[0].message_type[0].field:
        if field.label == FieldDescriptorProto.LABEL_REPEATED:
            field.options.packed = False
    data = rows(3)
    for row in data:
        message = as_message(row, LAYOUT, parser(files)).SerializeToString()
        assert_same_bits(StepFormat(LAYOUT).decode(as_bytes(message)), row[None])


def row_without_zeros() -> np.ndarray:
    """One row of which another protobuf writer leaves nothing out, so that sizes are equal."""
    data = rows(2)[1:]
    for name in FLAGS:
        data[:, LAYOUT.slices[name]] = 1.0
    return data


def test_bytes_are_protobufs_own_when_no_value_is_zero():
    data = row_without_zeros()
    expected = as_message(data[0], LAYOUT).SerializeToString()
    assert StepFormat(LAYOUT).encode(data).tobytes() == expected


def test_fields_in_another_order_decode_too():
    data = row_without_zeros()
    names = list(LAYOUT.widths)
    parts = []
    for kept in names:
        message = as_message(data[0], LAYOUT)
        for name in names:
            if name != kept:
                message.ClearField(name)
        parts.append(message.SerializeToString())
    parts[1], parts[2] = parts[2], parts[1]  # q and qd, which are of one size
    message = b"".join(parts)
    assert len(message) == StepFormat(LAYOUT).size
    assert_same_bits(StepFormat(LAYOUT).decode(as_bytes(message)), data)


def test_any_number_but_zero_is_a_true_flag():
    data = np.repeat(rows(1), 2, axis=0)
    data[:, LAYOUT.slices["deadline_missed"]] = [[0.0], [1.0]]
    messages = StepFormat(LAYOUT).encode(data)
    messages[1, messages[0] != messages[1]] = 2
    assert_same_bits(StepFormat(LAYOUT).decode(messages), data)


def test_schema_numbers_fields_in_the_order_of_the_layout():
    (message,) = schema().file[0].message_type
    assert [(f.name, f.number) for f in message.field] == [
        (name, k) for k, name in enumerate(LAYOUT.widths, start=1)
    ]
    kinds = {f.name: (f.type, f.label) for f in message.field}
    assert kinds["q"] == (FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_REPEATED)
    assert kinds["t"] == (FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_OPTIONAL)
    assert kinds["clipped"] == (FieldDescriptorProto.TYPE_BOOL, FieldDescriptorProto.LABEL_OPTIONAL)


def test_without_a_network_its_fields_are_absent_and_have_no_columns():
    layout = StepLayout(n_joints=2, n_layers=0)
    messages = StepFormat(layout).encode(rows(4, layout))
    assert not STEP.FromString(messages[0].tobytes()).weight_norm
    columns = layout.columns(StepFormat(layout).decode(messages))
    assert columns["weight_norm"].shape == (4, 0)


def test_no_rows_make_no_messages_and_back():
    wire = StepFormat(LAYOUT)
    assert wire.encode(rows(0)).shape == (0, wire.size)
    assert wire.decode(wire.encode(rows(0))).shape == (0, LAYOUT.width)


def test_decode_refuses_what_is_no_step():
    messages = StepFormat(LAYOUT).encode(rows(2))
    messages[1] = 0xFF
    with pytest.raises(ValueError, match=r"message 31 is no dnnmso\.Step"):
        StepFormat(LAYOUT).decode(messages, first=30)


def test_decode_refuses_vectors_of_another_width():
    longer = StepLayout(n_joints=3, n_layers=4)
    messages = StepFormat(longer).encode(rows(1, longer))
    with pytest.raises(ValueError, match="message 0 has 3 entries in q; expected 2"):
        StepFormat(LAYOUT).decode(messages)


def test_schema_check_names_the_fields_that_differ():
    check_schema(schema().SerializeToString())
    files = schema()
    files.file[0].message_type[0].field[1].name = "angles"
    with pytest.raises(ValueError, match=r"differ from this version's in angles, q$"):
        check_schema(files.SerializeToString())
    damaged = schema().SerializeToString().replace(b"q_meas", b"q_\xffeas")
    with pytest.raises(ValueError, match=r"differ from this version's in .*q_meas"):
        check_schema(damaged)
    with pytest.raises(ValueError, match="no protobuf FileDescriptorSet"):
        check_schema(b"\xff\xff")
