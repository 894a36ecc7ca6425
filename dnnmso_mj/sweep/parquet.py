"""Tables in Parquet files that may be torn, flipped or made to hurt whoever reads them."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.log.opening import open_regular

SEAL = b"dnnmso_seal"  # key of the metadata: a checksum of what the pages' own do not cover
ROWS = 1_000  # that a file of any size may have; a row of ours takes 20 bytes and more
MOST = 32 << 20  # bytes in memory of a small file's table


class TableError(DnnmsoError):
    """A Parquet file that is damaged or too large; the message has no file name."""


def write_parquet(table: pa.Table, out: pa.NativeFile | object) -> None:
    """Write a table with checksums of all that it holds.

    Raises:
        OSError: it cannot be written.
    """
    metadata = {**(table.schema.metadata or {}), SEAL: _seal(table)}
    pq.write_table(table.replace_schema_metadata(metadata), out, write_page_checksum=True)


def read_parquet(path: Path) -> pa.Table:
    """Read a table, its checksums compared; one of an older version may have none.

    Raises:
        TableError: it is damaged, no table, no regular file or larger than its file may hold.
        OSError: it cannot be opened.
    """
    stream, size = open_regular(path)
    with stream:
        data = stream.read(size)
    try:
        file = pq.ParquetFile(io.BytesIO(data), page_checksum_verification=True)
        strings = _check_size(file.metadata, file.schema_arrow, size)
        table = pq.ParquetFile(
            io.BytesIO(data), page_checksum_verification=True, read_dictionary=strings
        ).read()
        table = _plain(table, strings, size)
        table.validate(full=True)
    except (pa.ArrowException, OSError, ArithmeticError, MemoryError) as error:
        raise TableError(f"{type(error).__name__}: {error}") from error
    metadata = dict(table.schema.metadata or {})
    seal = metadata.pop(SEAL, None)
    table = table.replace_schema_metadata(metadata)
    if seal not in (None, _seal(table)):
        raise TableError("it is not what its checksum says")
    return table


def _seal(table: pa.Table) -> bytes:
    """Of names, types, metadata and the number of rows."""
    fields = "\n".join(f"{field.name}: {field.type}" for field in table.schema)
    metadata = sorted((table.schema.metadata or {}).items())
    return hashlib.sha256(repr((fields, metadata, len(table))).encode()).hexdigest().encode()


def _check_size(found: pq.FileMetaData, schema: pa.Schema, size: int) -> list[str]:
    """Refuse more rows than the file can hold; the names of columns of text."""
    groups = [found.row_group(k) for k in range(found.num_row_groups)]
    rows = sum(group.num_rows for group in groups)
    most = ROWS + size // 16
    if rows != found.num_rows or not 0 <= rows <= most:
        raise TableError(f"{found.num_rows} rows; allowed: {most} in a file of {size} bytes")
    if rows * len(schema) * 8 > MOST + 4 * size:
        raise TableError(f"{rows} rows of {len(schema)} columns, too many for its size")
    return [field.name for field in schema if pa.types.is_string(field.type)]


def _plain(table: pa.Table, strings: list[str], size: int) -> pa.Table:
    """The same with texts spelled out, which were one number each so far."""
    for name in strings:
        place, column = table.schema.get_field_index(name), table[name]
        if not pa.types.is_dictionary(column.type):
            continue
        length = 0
        for chunk in column.chunks:
            lengths = pc.binary_length(chunk.dictionary)
            length += pc.sum(lengths.take(chunk.indices)).as_py() or 0
        if length > MOST + 4 * size:
            raise TableError(f"{length} characters in {name}, too many for its size")
        field = pa.field(name, pa.string(), table.schema.field(place).nullable)
        table = table.set_column(place, field, column.cast(pa.string()))
    return table
