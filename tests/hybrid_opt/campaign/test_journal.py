"""A journal keeps every whole block, whatever happened to the file behind it."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.campaign.journal import Journal, candidates_in, decode_generation, encode_generation
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluations import Evaluations
from tests.hybrid_opt.campaign.fake import verdicts

IDENTITY = bytes(range(32))
BLOCKS = [
    encode_generation(0.5 * n, verdicts(np.random.default_rng(n).random((n, 4)))) for n in (3, 1, 7)
]


def write(path: Path, blocks: list[bytes] = BLOCKS) -> bytes:
    journal = Journal(path, IDENTITY)
    for block in blocks:
        journal.append(block)
    journal.close()
    return path.read_bytes()


def reopened(path: Path) -> list[bytes]:
    journal = Journal(path, IDENTITY)
    journal.close()
    return journal.payloads


def test_a_generation_survives_to_the_bit() -> None:
    x = np.random.default_rng(1).random((9, 4))
    x[2, 0] = 0.31
    found = verdicts(x)
    seconds, again = decode_generation(encode_generation(1.25, found), 4, 2)
    assert seconds == 1.25
    for field in fields(Evaluations):
        before, after = getattr(found, field.name), getattr(again, field.name)
        assert (before.dtype, before.tobytes()) == (after.dtype, after.tobytes())
    assert candidates_in(encode_generation(0.0, found)) == 9


@pytest.mark.parametrize(("n_var", "n_obj"), [(3, 2), (5, 2), (4, 3), (4, 1)])
def test_blocks_of_another_problem_are_refused(n_var: int, n_obj: int) -> None:
    with pytest.raises(ResultsError, match="does not fit the problem"):
        decode_generation(BLOCKS[0], n_var, n_obj)


@given(st.data())
def test_cut_anywhere_keeps_the_whole_blocks(data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "journal.bin"
        whole = write(path)
        cut = data.draw(st.integers(0, len(whole)))
        path.write_bytes(whole[:cut])
        ends = np.cumsum([40, *(8 + len(block) for block in BLOCKS)])
        kept = max(int(np.count_nonzero(ends <= cut)) - 1, 0)
        assert reopened(path) == BLOCKS[:kept]
        # What was cut off can be written again.
        assert write(path, BLOCKS[kept:]) == whole


@given(st.data())
def test_damage_anywhere_is_never_read(data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "journal.bin"
        whole = bytearray(write(path))
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place] ^= data.draw(st.integers(1, 255))
        path.write_bytes(whole)
        if place < 40:
            with pytest.raises(ResultsError, match="belongs to another campaign"):
                reopened(path)
        else:
            found = reopened(path)
            assert len(found) < len(BLOCKS)
            assert found == BLOCKS[: len(found)]


def test_another_identity_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "journal.bin")
    with pytest.raises(ResultsError, match="belongs to another campaign or version; delete it"):
        Journal(tmp_path / "journal.bin", bytes(32))


def test_discarding_removes_the_file(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "a/journal.bin", IDENTITY)
    journal.append(BLOCKS[0])
    journal.discard()
    assert not journal.path.exists()
