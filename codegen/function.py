"""Numeric functions that NumPy calls: their common interface.

CasADi stores matrices by column. A CasADi (r, c) matrix is therefore a NumPy (c, r) array in C
order without a copy; a column or row vector is (n,) and a scalar (1, 1) is ().

Arrays are C-contiguous float64 and are passed by address, never copied. `__call__` and `batch`
convert other inputs to such arrays.
"""

from __future__ import annotations

import ctypes
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass
from functools import cached_property
from math import prod
from operator import mul
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codegen.errors import CodegenError
from symbolic.array import Array

if TYPE_CHECKING:
    import casadi as ca

_FLOAT = np.dtype(np.float64)

# Under short names for speed; NumPy arrays are buffers, which their type does not say.
_writable: Any = ctypes.c_char.from_buffer
_address_of = ctypes.addressof

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Signature:
    """Name, arguments and results of a numeric function; every array is dense float64.

    Attributes:
        name: name of the function.
        input_names, output_names: names of the inputs and outputs, in call order.
        input_shapes, output_shapes: NumPy shape of each input and output in one evaluation.
    """

    name: str
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_shapes: tuple[Shape, ...]
    output_shapes: tuple[Shape, ...]

    @classmethod
    def of(cls, function: ca.Function) -> Signature:
        """Return the signature of a CasADi function. Sparse inputs and outputs count as dense."""
        return cls(
            name=function.name(),
            input_names=tuple(function.name_in()),
            output_names=tuple(function.name_out()),
            input_shapes=tuple(numpy_shape(*function.size_in(i)) for i in range(function.n_in())),
            output_shapes=tuple(
                numpy_shape(*function.size_out(i)) for i in range(function.n_out())
            ),
        )

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Signature:
        """Build the signature from the dictionary that `to_json` returned."""
        return cls(**{name: _as_tuple(value) for name, value in stored.items()})

    def to_json(self) -> dict[str, Any]:
        """Return the signature as a dictionary of strings and lists, ready for JSON."""
        found: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return found

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Number of entries of each input, then of each output, in one evaluation."""
        return tuple(map(prod, (*self.input_shapes, *self.output_shapes)))

    def output_record(self) -> np.dtype[np.void]:
        """Return the structured type that holds all outputs of one evaluation in one block of
        memory."""
        return np.dtype(
            [
                (name, np.float64, shape)
                for name, shape in zip(self.output_names, self.output_shapes, strict=True)
            ]
        )


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value


def numpy_shape(rows: int, columns: int) -> Shape:
    """Return the NumPy shape in which a dense CasADi matrix (rows, columns) is passed.

    It is () for a scalar, (n,) for a row or a column, and (columns, rows), the transpose, for other
    matrices, because CasADi stores them column by column.
    """
    if rows == 1 or columns == 1:
        return () if rows == columns else (rows * columns,)
    return (columns, rows)


class NumericFunction(ABC):
    """A function from dense float64 arrays to dense float64 arrays.

    Attributes:
        signature: names and shapes of all inputs and outputs.
        name: name of the function.
        input_names, input_shapes: names and shapes of the inputs that have no bound value.
        output_names, output_shapes: names and shapes of the outputs.
    """

    def __init__(self, signature: Signature) -> None:
        self.signature = signature
        self.name = signature.name
        self.input_names = signature.input_names
        self.output_names = signature.output_names
        self.input_shapes = signature.input_shapes
        self.output_shapes = signature.output_shapes
        self._record = signature.output_record()
        self._bound: list[Array] = []

    def bound(self, values: Mapping[str, Array]) -> Self:
        """Return a copy of the function with fixed values for its last inputs.

        The last input is bound first, and binding stops at the first name missing in `values`.

        Args:
            values: array for each input name, with the shape of that input.

        Raises:
            CodegenError: a value does not fit.
        """
        names, shapes = self.signature.input_names, self.signature.input_shapes
        count = next((k for k, name in enumerate(names[::-1]) if name not in values), len(names))
        free = len(names) - count
        other = copy(self)
        other.input_names, other.input_shapes = names[:free], shapes[:free]
        other._bound = [self._as_array(values[name], name) for name in names[free:]]
        for array, name, shape in zip(other._bound, names[free:], shapes[free:], strict=True):
            if array.shape != shape:
                raise self._wrong_shape(name, array.shape, str(shape))
        return other

    def __call__(self, *inputs: ArrayLike) -> dict[str, Array]:
        """Evaluate the function for one set of inputs.

        Args:
            inputs: one array per input, of its shape in `input_shapes`.

        Returns:
            The outputs by name, in their `output_shapes`; they share one block of memory.

        Raises:
            CodegenError: a wrong number of inputs, a wrong shape or type, or the function failed.
        """
        self._require_count(len(inputs))
        arrays = []
        for given, name, shape in zip(inputs, self.input_names, self.input_shapes, strict=True):
            array = self._as_array(given, name)
            if array.shape != shape:
                raise self._wrong_shape(name, array.shape, str(shape))
            arrays.append(array)
        block = np.empty((), self._record)
        self._evaluate_block([*arrays, *self._bound], block)
        return {name: block[name] for name in self.output_names}

    def batch(self, *inputs: ArrayLike, threads: int = 1) -> dict[str, Array]:
        """Evaluate the function for n sets of inputs, called candidates.

        Args:
            inputs: one array per input: (n, ...) with its shape in `input_shapes` after n, or of
                this shape alone, shared by all candidates.
            threads: threads to spread the candidates over; 0 for one per core that this process may
                use. The results do not depend on it. Interpreted functions use one.

        Returns:
            The outputs by name, each (n, ...) with its shape in `output_shapes` after n.

        Raises:
            CodegenError: inputs that do not fit or agree on n, or the function failed.
        """
        self._require_count(len(inputs))
        if threads < 0:
            raise CodegenError(
                f"{self.name}: threads is {threads}; give 0 (all cores) or more", code="threads"
            )
        arrays: list[Array] = []
        batched: list[bool] = []
        n = -1
        for given, name, shape in zip(inputs, self.input_names, self.input_shapes, strict=True):
            array = self._as_array(given, name)
            per_candidate = array.shape != shape
            if per_candidate:
                if array.shape[1:] != shape or array.ndim != len(shape) + 1:
                    raise self._wrong_shape(name, array.shape, f"{shape} or (n, *{shape})")
                if n not in (-1, array.shape[0]):
                    raise CodegenError(
                        f"{self.name}: input '{name}' has {array.shape[0]} candidates, an input "
                        f"before it {n}; give each the same number, or one value for all",
                        code="candidate-count",
                    )
                n = array.shape[0]
            arrays.append(array)
            batched.append(per_candidate)
        if n < 0:
            raise CodegenError(
                f"{self.name}: no input has a leading axis of candidates; give at least one as "
                "(n, *shape), or call the function for one evaluation",
                code="no-leading-axis",
            )
        outputs = [np.empty((n, *shape)) for shape in self.output_shapes]
        if n:
            whole = [*arrays, *self._bound], [*batched, *[False] * len(self._bound)]
            self._evaluate_batch(*whole, outputs, n, threads or available_cores())
        return dict(zip(self.output_names, outputs, strict=True))

    def prepared(
        self, n: int, shared: Collection[str] = (), given: Mapping[str, Array] | None = None
    ) -> PreparedBatch:
        """Prepare a batch of up to n evaluations on fixed arrays, which can be evaluated
        repeatedly.

        This pays if one evaluation takes little time compared with the checks and allocations of
        `batch`.

        Args:
            n: largest number of evaluations, at least 1.
            shared: names of inputs with one value for all evaluations.
            given: the caller's own arrays for some inputs and outputs, each C-contiguous and (n,
                ...) with its shape after n; shared inputs without n. None to allocate all arrays.

        Raises:
            CodegenError: an array does not fit.
        """
        given = given or {}
        names = (*self.input_names, *self.output_names)
        shapes = [
            shape if name in shared else (n, *shape)
            for name, shape in zip(names, (*self.input_shapes, *self.output_shapes), strict=True)
        ]
        own = [
            given[name] if name in given else np.zeros(shape)
            for name, shape in zip(names, shapes, strict=True)
        ]
        for array, name, shape in zip(own, names, shapes, strict=True):
            flags = array.flags
            if not flags.carray or array.dtype != _FLOAT or array.shape != shape:
                raise CodegenError(
                    f"{self.name}: array '{name}' is {array.dtype} {array.shape}, C-contiguous "
                    f"{flags.c_contiguous}, writable {flags.writeable}; needed is C-contiguous "
                    f"writable float64 {shape}",
                    code="wrong-array",
                )
        split = len(self.input_names)
        inputs = dict(zip(names[:split], own[:split], strict=True))
        outputs = dict(zip(names[split:], own[split:], strict=True))
        batched = [name not in shared for name in self.input_names] + [False] * len(self._bound)
        arrays = [*inputs.values(), *self._bound], list(outputs.values())
        run, native = self._prepared(arrays[0], batched, arrays[1])
        return PreparedBatch(inputs, outputs, n, run, native)

    def _prepared(
        self, inputs: Sequence[Array], batched: Sequence[bool], outputs: Sequence[Array]
    ) -> tuple[Callable[[int], None], Callable[[], NativeCall] | None]:
        """Prepare repeated evaluations of one batch, whose arrays stay at their addresses.

        Args:
            inputs: input arrays of the batch.
            batched: for each input, True if it has one value per evaluation.
            outputs: arrays for the results.

        Returns:
            - Function of k that evaluates the first k items of the batch.
            - Function that returns the addresses by which other C code calls this evaluation; None
              if the function is interpreted, so that C code cannot call it.
        """

        def run(count: int) -> None:
            self._evaluate_batch(inputs, batched, outputs, count, 1)

        return run, None

    @abstractmethod
    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        """Evaluate once for the arrays `inputs`, and write all outputs into the record `block`.

        The record has the type `Signature.output_record`.
        """

    @abstractmethod
    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        """Evaluate a batch of n > 0 candidates, and write the results into `outputs`.

        Args:
            inputs: input arrays.
            batched: for each input, True if it has one value per candidate.
            outputs: arrays for the results, with one value per candidate.
            n: number of candidates.
            threads: number of threads that share the batch.
        """

    def _require_count(self, given: int) -> None:
        if given != len(self.input_names):
            raise CodegenError(
                f"{self.name}: {given} inputs given, {len(self.input_names)} needed: "
                f"{', '.join(self.input_names)}",
                code="input-count",
            )

    def _as_array(self, given: ArrayLike, name: str) -> Array:
        try:
            # Only casts that keep the value: integers and booleans, never complex or text.
            array = np.asarray(given)
            if array.dtype != _FLOAT:
                array = array.astype(_FLOAT, casting="same_kind")
        except (TypeError, ValueError) as error:
            raise CodegenError(
                f"{self.name}: input '{name}' is not an array of real numbers: {error}",
                code="input-type",
            ) from error
        flags = array.flags
        if flags.carray or (flags.c_contiguous and flags.aligned):
            return array
        return array.copy(order="C")

    def _wrong_shape(self, name: str, found: Shape, needed: str) -> CodegenError:
        return CodegenError(
            f"{self.name}: input '{name}' has shape {found}, needed is {needed}", code="input-shape"
        )


@dataclass(frozen=True)
class NativeCall:
    """Addresses with which C evaluates a prepared batch, valid as long as the batch exists.

    Attributes:
        one, lanes: addresses of the C functions `dual_arm_run` and `dual_arm_run_lanes` of
            `codegen/c`; `lanes` is 0 for a function without lanes.
        ports: address of the descriptions of arguments and results.
        work, lane_work: addresses of the work memory of `dual_arm_run` and of `dual_arm_run_lanes`.
    """

    one: int
    lanes: int
    ports: int
    work: int
    lane_work: int


class PreparedBatch:
    """A batch that is evaluated repeatedly. Threads must not share one.

    Attributes:
        inputs, outputs: arrays by name. The caller writes inputs and reads outputs; every call
            overwrites the outputs.
        size: largest number of evaluations.
    """

    def __init__(
        self,
        inputs: dict[str, Array],
        outputs: dict[str, Array],
        size: int,
        run: Callable[[int], None],
        native: Callable[[], NativeCall] | None = None,
    ) -> None:
        """Store the arrays and the functions that evaluate them.

        Args:
            inputs, outputs: arrays by name.
            size: largest number of evaluations.
            run: function that evaluates the first items of the batch, given their number.
            native: function that returns the addresses with which C code evaluates the batch; None
                if C cannot evaluate the function.
        """
        self.inputs, self.outputs, self.size, self._run = inputs, outputs, size, run
        self._native = native

    @property
    def native(self) -> NativeCall | None:
        """Addresses by which other C code evaluates this batch in the calling thread; None for
        interpreted functions."""
        return None if self._native is None else self._native()

    def __call__(self, count: int | None = None) -> dict[str, Array]:
        """Evaluate the first items of the batch and return the outputs by name.

        Args:
            count: number of items to evaluate, at most `size`; None for all.

        Returns:
            The arrays of the attribute `outputs` themselves, not copies, each (`size`, ...) with
            the output's shape after `size`. The first `count` rows are new; the other rows keep
            their earlier values. The next call overwrites them.

        Raises:
            CodegenError: the function failed, or the batch does not fit into memory.
        """
        wanted = self.size if count is None else count
        if not 0 <= wanted <= self.size:
            raise CodegenError(
                f"{wanted} evaluations wanted; there is room for {self.size}",
                code="too-many-evaluations",
            )
        if wanted:
            self._run(wanted)
        return self.outputs


def ports(
    signature: Signature,
    inputs: Sequence[Array],
    batched: Sequence[bool],
    outputs: Sequence[NDArray[Any]],
) -> ctypes.Array[ctypes.c_longlong]:
    """Describe the arrays of a batch to the drivers in C (`codegen/c/driver.c`).

    The result has two integers per array, inputs first: the address of the array, and the step from
    one evaluation to the next, counted in entries; 0 for an input with one value for all.

    Args:
        signature: signature of the function.
        inputs, outputs: the arrays.
        batched: for each input, True if it has one value per evaluation.
    """
    arrays, sizes = [*inputs, *outputs], signature.sizes
    steps = [*map(mul, sizes, batched), *sizes[len(batched) :]]
    found = (ctypes.c_longlong * (2 * len(sizes)))()
    for k, (array, step) in enumerate(zip(arrays, steps, strict=True)):
        try:
            found[2 * k] = _address_of(_writable(array))
        except (TypeError, ValueError):  # read-only or empty
            found[2 * k] = array.ctypes.data if array.size else 0
        found[2 * k + 1] = step
    return found


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1
