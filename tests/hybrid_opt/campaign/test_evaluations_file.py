"""Files of candidates give back the same bits, and can be read without this project."""

from __future__ import annotations

import csv
import gzip
import io
import re
import tracemalloc
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hybrid_opt.campaign.journal import EvaluationTable, decode, encode, encode_front
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluations import REASONS, Evaluations
from tests.hybrid_opt.campaign.fake import OBJECTIVES, verdicts

PATH = Path("evaluations.csv.gz")


def table(count: int = 30) -> EvaluationTable:
    x = np.random.default_rng(3).random((count, 4))
    x[::7, 0] = 0.31
    return EvaluationTable(verdicts(x), np.arange(count, dtype=np.int64) // 8 + 1, OBJECTIVES)


def test_table_survives_to_the_bit() -> None:
    before = table()
    after = decode(encode(before), PATH)
    assert after.objective_names == OBJECTIVES
    np.testing.assert_array_equal(after.generation, before.generation)
    for field in fields(Evaluations):
        old = getattr(before.evaluations, field.name)
        new = getattr(after.evaluations, field.name)
        assert (old.dtype, old.shape, old.tobytes()) == (new.dtype, new.shape, new.tobytes())


def test_files_from_before_a_reason_was_added_are_read() -> None:
    before = table()
    header, *lines = gzip.decompress(encode(before)).decode().splitlines()
    names = header.split(",")
    kept = [k for k, name in enumerate(names) if not name.endswith("no_timing")]
    old = [",".join(line.split(",")[k] for k in kept) for line in (header, *lines)]
    after = decode(gzip.compress(("\n".join(old) + "\n").encode()), PATH).evaluations
    np.testing.assert_array_equal(after.violation, before.evaluations.violation)
    np.testing.assert_array_equal(after.violation_time, before.evaluations.violation_time)
    np.testing.assert_array_equal(after.reason, before.evaluations.reason)


@given(hnp.arrays(np.float64, (2, 4), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_any_number_survives(x: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    found = verdicts(np.full((2, 4), 0.5))
    arrays = {f.name: getattr(found, f.name) for f in fields(Evaluations)} | {"x": x}
    names = EvaluationTable(Evaluations(**arrays), np.ones(2, dtype=np.int64), OBJECTIVES)
    assert decode(encode(names), PATH).evaluations.x.tobytes() == x.tobytes()


def test_columns_mean_what_they_say() -> None:
    before = table()
    rows = list(csv.DictReader(io.StringIO(gzip.decompress(encode(before)).decode())))
    found = before.evaluations
    assert [int(row["evaluation"]) for row in rows] == list(range(1, 31))
    for k, row in enumerate(rows):
        assert row["feasible"] == str(int(found.feasible[k]))
        assert row["reason"] == ("" if found.feasible[k] else REASONS[found.reason[k]])
        assert float(row["x_4"]) == found.x[k, 3]
        if not np.isnan(found.penalised[k, 1]):
            assert float(row["penalised_peak_force_2"]) == found.penalised[k, 1]
        collision = REASONS.index("collision")
        assert float(row["violation_collision"]) == found.violation[k, collision]
        assert float(row["violation_time_collision"]) == found.violation_time[k, collision]


def test_same_table_same_bytes() -> None:
    assert encode(table()) == encode(table())


def test_front_names_its_evaluations() -> None:
    before = table()
    text = encode_front(before, np.array([4, 2])).decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["evaluation"] for row in rows] == ["5", "3"]
    assert float(rows[0]["x_1"]) == before.evaluations.x[4, 0]
    assert float(rows[1]["peak_force_2"]) == before.evaluations.objectives[2, 1]


def unpacked(content: bytes) -> bytes:
    return gzip.decompress(content)


def test_a_small_file_does_not_unfold_into_a_huge_one() -> None:
    header = unpacked(encode(table())).partition(b"\n")[0] + b"\n"
    tracemalloc.start()
    packed = gzip.compress(header + b"0" * 2**28, 1)
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    with pytest.raises(ResultsError, match=r"a line of more than"):
        decode(packed, PATH)
    assert tracemalloc.get_traced_memory()[1] - before < 2**24
    tracemalloc.stop()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: content[:-20],
        lambda content: b"not gzip",
        lambda content: gzip.compress(b""),
        lambda content: gzip.compress(gzip.decompress(content).replace(b"x_1", b"y_1")),
        lambda content: gzip.compress(
            gzip.decompress(content).replace(b"collision,", b"luck,", 99)
        ),
        lambda content: gzip.compress(gzip.decompress(content).replace(b"\n3,", b"\n4,")),
        lambda content: gzip.compress(gzip.decompress(content).replace(b"0.", b"zero", 40)),
        lambda content: gzip.compress(gzip.decompress(content).replace(b"\n3,", b"\n\n3,")),
        lambda content: gzip.compress(gzip.decompress(content).partition(b"\n")[0] + b"\n"),
        lambda content: gzip.compress(gzip.decompress(content) + b"31,1,1,,0.0\n"),
        lambda content: gzip.compress(re.sub(rb"\n1,\d+,", rb"\n1,1e308,", unpacked(content))),
        lambda content: gzip.compress(re.sub(rb"\n1,(\d+),\d,", rb"\n1,\1,2,", unpacked(content))),
        lambda content: gzip.compress(re.sub(rb",[^,]*\n2,", rb",x\n2,", unpacked(content))),
    ],
)
def test_damage_is_told(spoil: object) -> None:
    assert callable(spoil)
    with pytest.raises(ResultsError, match=r"evaluations.csv.gz: damaged"):
        decode(spoil(encode(table())), PATH)
