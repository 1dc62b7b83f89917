"""Files of reference fronts: read as written, or refused with their name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.errors import ResultsError
from studies.research.best_front import ReferenceFront, encode, read_reference_front

HEAD = b"# made with: a\n# workcell: b\npeak_force_1,peak_force_2,x_1\n"


def test_a_front_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    front = ReferenceFront("0" * 64, rng.random((5, 2)), rng.random((5, 18)))
    path = tmp_path / "front.csv"
    path.write_bytes(encode(front, "a command"))
    found = read_reference_front(path)
    assert found.digest == front.digest
    np.testing.assert_array_equal(found.objectives, front.objectives)
    np.testing.assert_array_equal(found.x, front.x)
    assert not found.x.flags.writeable


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "index out of range"),
        (HEAD, "two objectives and a decision"),
        (HEAD + b"1,2\n", "two objectives and a decision"),
        (HEAD + b"1,2,3\n4,5\n", "inhomogeneous"),
        (HEAD + b"1,2,nan\n", "not finite"),
        (HEAD + b"1,2,1e999\n", "not finite"),
        (HEAD + b"1,2,a\n", "could not convert"),
        (HEAD + b"1,2,\xff\n", "can't decode"),
        (HEAD + b"1,2,3\n" * 400_000, "more than 1000000 values"),
    ],
)
def test_what_is_none_is_told(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "front.csv"
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=rf"front.csv: no reference front \(.*{words}") as caught:
        read_reference_front(path)
    assert "\n" not in str(caught.value)
