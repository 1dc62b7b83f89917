"""The polish's own C: records and functions as its files declare them.

What a library offers stands in its file between `BEGIN` and `END`, in the part of C that cffi
reads: nothing is declared a second time here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cffi
import numpy as np
from numpy.typing import NDArray

from codegen.build import c_text, load_or_build_library
from codegen.cache import Cache
from codegen.errors import CodegenError
from codegen.function import PreparedBatch

BEGIN, END = "/* ---- offered ---- */", "/* ---- within ---- */"

_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_TYPES = {"double": np.float64, "long long": np.int64, "char": np.int8}


class Native:
    """A loaded library.

    Attributes:
        functions: of C, by attribute.
    """

    def __init__(self, file: str, kept: Cache) -> None:
        text = c_text("hybrid_opt.polishing", ("common.c", file))
        offered = text[text.index(BEGIN) : text.index(END)].replace("OFFERED ", "")
        self.ffi = cffi.FFI()
        self.ffi.cdef("typedef long long integer;" + _COMMENT.sub("", offered))
        self.functions: Any = self.ffi.dlopen(
            load_or_build_library(Path(file).stem, text, kept)._name
        )


def native(file: str, kept: Cache | None = None) -> Native:
    """A C file of the polish as a library, once per process.

    Args:
        kept: where it is kept; by default the user's cache.

    Raises:
        CodegenError: there is no compiler, or it cannot be compiled, cached or loaded.
    """
    return _loaded(file, (kept or Cache()).folder)


@cache
def _loaded(file: str, folder: Path) -> Native:
    return Native(file, Cache(folder))


class Records:
    """Records of one library and the arrays that they point to, alive as long as this is."""

    def __init__(self, library: Native) -> None:
        self._ffi, self._kept = library.ffi, list[object]()

    def new(self, kind: str, **fields: Any) -> Any:
        """A pointer to a record with such fields; others are zero."""
        made = self._ffi.new(f"{kind} *")
        self._kept.append(made)
        self.fill(made, **fields)
        return made

    def array(self, kind: str, records: Sequence[Any]) -> Any:
        """Copies of records, one after the other."""
        made = self._ffi.new(f"{kind}[]", [record[0] for record in records])
        self._kept.append(made)
        return made

    def fill(self, record: Any, **fields: Any) -> None:
        """Set fields: numbers, arrays, which C then reads and writes where they are (of those that
        are not contiguous, or of another type, copies), and records or pointers to them."""
        kinds = dict(self._ffi.typeof(record).item.fields)
        for name, value in fields.items():
            kind = kinds[name].type
            if isinstance(value, np.ndarray):
                setattr(record, name, self._address(kind, value))
            elif kind.kind in ("function", "pointer") and isinstance(value, int):
                setattr(record, name, self._ffi.cast(kind, value))
            else:
                setattr(record, name, value[0] if kind.kind == "struct" else value)

    def point(self, pointers: Any, k: int, array: NDArray[Any]) -> None:
        """Let one of a field's pointers point to an array."""
        pointers[k] = self._address(self._ffi.typeof(pointers).item, array)

    def call(self, batch: PreparedBatch) -> Any:
        """How C evaluates a batch of a compiled function, a `Call`.

        Raises:
            CodegenError: the function is interpreted.
        """
        self._kept.append(batch)
        found = batch.native
        if found is None:
            raise CodegenError("the polish needs compiled functions, and these are interpreted")
        lanes = {"lanes": found.lanes} if found.lanes else {}
        addresses = {"ports": found.ports, "work": found.work, "lane_work": found.lane_work}
        return self.new("Call", one=found.one, **lanes, **addresses)

    def _address(self, kind: Any, array: NDArray[Any]) -> Any:
        kept = np.ascontiguousarray(array, dtype=_TYPES[kind.item.cname])
        self._kept.append(kept)
        return self._ffi.cast(kind, kept.ctypes.data)
