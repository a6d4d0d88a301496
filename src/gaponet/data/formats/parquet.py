"""Parquet files of strangers: read in the sandbox, and what they say that they hold is counted
first.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.base.structure import MAX_ARRAYS_BYTES
from gaponet.data.describe.raw_recording import reading

if TYPE_CHECKING:
    import pyarrow as pa


@sandboxed(LogError, "pyarrow.parquet")
def header(file: Path) -> tuple[list[str], dict[str, str]]:
    """Names of the columns, in their order, and what the file says of itself beside."""
    import pyarrow.parquet as pq

    with reading(file, "Parquet file"):
        schema = pq.read_schema(file)
        metadata = {}
        for key, value in (schema.metadata or {}).items():
            metadata[key.decode("utf-8", "replace")] = value.decode("utf-8", "replace")
        return list(schema.names), metadata


@sandboxed(LogError, "pyarrow.parquet")
def list_widths(file: Path) -> dict[str, int]:
    """Columns whose cells are lists of numbers → how many numbers the first cell holds."""
    import pyarrow.parquet as pq

    with reading(file, "Parquet file"):
        schema = pq.read_schema(file)
        numbers = [field.name for field in schema if _holds_numbers(field.type)]
        if not numbers:
            return {}
        first = next(pq.ParquetFile(file).iter_batches(1, columns=numbers, use_threads=False), None)
        if first is None:
            return {}
        cells = {name: first.column(name)[0].as_py() for name in numbers}
        return {name: len(cell) for name, cell in cells.items() if cell}


def _holds_numbers(kind: pa.DataType) -> bool:
    """Return True if cells of a column are lists of numbers."""
    import pyarrow as pa

    tests = (pa.types.is_list, pa.types.is_fixed_size_list, pa.types.is_large_list)
    if not any(is_list(kind) for is_list in tests):
        return False
    return bool(pa.types.is_integer(kind.value_type) or pa.types.is_floating(kind.value_type))


@sandboxed(LogError, "pyarrow.parquet")
def read(file: Path, wanted: list[str]) -> pa.Table:
    """These columns.

    Raises:
        LogError: No Parquet file, a column is missing, or there is more than MAX_ARRAYS_BYTES in
            them.
    """
    import pyarrow.parquet as pq

    with reading(file, "Parquet file"):
        source = pq.ParquetFile(file)
        values = _count_values(source, wanted)
        if 8 * values > MAX_ARRAYS_BYTES:
            raise LogError(
                f"{file}: {source.metadata.num_rows:,} rows of {len(wanted)} columns are "
                f"{values:,} values, more than {MAX_ARRAYS_BYTES >> 20} MiB; cut the log into "
                "shorter ones"
            )
        return source.read(columns=wanted, use_threads=False).select(wanted)


def _count_values(file: Any, wanted: list[str]) -> int:
    """Return how many values some columns of a pyarrow.parquet.ParquetFile hold, by its footer."""
    values = 0
    for i in range(file.metadata.num_row_groups):
        group = file.metadata.row_group(i)
        for k in range(group.num_columns):
            chunk = group.column(k)
            if chunk.path_in_schema.split(".")[0] in wanted:
                values += chunk.num_values
    return values
