"""A campaign's settings and files of candidates."""

from __future__ import annotations

import csv
import gzip
import io
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.campaign.candidates import EvaluatedCandidates, decode, encode
from hybrid_opt.campaign.settings import chosen
from hybrid_opt.campaign.stages import drivable_settings
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import REASONS, Evaluations
from hybrid_opt.store.files import from_json, to_json
from symbolic.errors import SettingsError
from tests.hybrid_opt.campaign.fake import OBJECTIVES, verdicts
from tests.refusals import refused

PATH = Path("00.csv.gz")


def table(count: int = 30) -> EvaluatedCandidates:
    x = np.random.default_rng(3).random((count, 4))
    x[::7, 0] = 0.31
    return EvaluatedCandidates(verdicts(x), OBJECTIVES, 1.25)


def test_table_survives_to_the_bit() -> None:
    before = table()
    after = decode(encode(before), PATH)
    assert after.objective_names == OBJECTIVES
    assert after.seconds == before.seconds
    for field in fields(Evaluations):
        old = getattr(before.evaluations, field.name)
        new = getattr(after.evaluations, field.name)
        assert (old.dtype, old.shape, old.tobytes()) == (new.dtype, new.shape, new.tobytes())


def test_files_from_before_a_reason_was_added_are_read() -> None:
    before = table()
    comment, header, *lines = gzip.decompress(encode(before)).decode().splitlines()
    names = header.split(",")
    kept = [k for k, name in enumerate(names) if not name.endswith("no_timing")]
    old = [",".join(line.split(",")[k] for k in kept) for line in (header, *lines)]
    after = decode(gzip.compress(("\n".join([comment, *old]) + "\n").encode()), PATH).evaluations
    np.testing.assert_array_equal(after.violation, before.evaluations.violation)
    np.testing.assert_array_equal(after.violation_time, before.evaluations.violation_time)
    np.testing.assert_array_equal(after.reason, before.evaluations.reason)


@given(hnp.arrays(np.float64, (2, 4), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_any_number_survives(x: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    found = verdicts(np.full((2, 4), 0.5))
    arrays = {f.name: getattr(found, f.name) for f in fields(Evaluations)} | {"x": x}
    names = EvaluatedCandidates(Evaluations(**arrays), OBJECTIVES, 0.0)
    assert decode(encode(names), PATH).evaluations.x.tobytes() == x.tobytes()


def test_columns_mean_what_they_say() -> None:
    before = table()
    text = io.StringIO(gzip.decompress(encode(before)).decode())
    assert text.readline() == "# seconds: 1.25\n"
    rows = list(csv.DictReader(text))
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


def test_a_small_file_does_not_unfold_into_a_huge_one() -> None:
    header = b"".join(gzip.decompress(encode(table())).splitlines(keepends=True)[:2])
    tracemalloc.start()
    packed = gzip.compress(header + b"0" * 2**28, 1)
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    with refused(ResultsError, "damaged"):
        decode(packed, PATH)
    assert tracemalloc.get_traced_memory()[1] - before < 2**24
    tracemalloc.stop()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: b"",
        lambda text: text.replace(b"x_1", b"y_1"),
        lambda text: text.replace(b"collision,", b"luck,", 99),
        lambda text: text.replace(b"\n3,", b"\n4,"),
        lambda text: text.replace(b"0.", b"zero", 40),
        lambda text: text.replace(b"\n3,", b"\n\n3,"),
        lambda text: b"".join(text.splitlines(keepends=True)[:2]),
        lambda text: text + b"31,1,,0.0\n",
        lambda text: re.sub(rb"\n1,\d,", rb"\n1,2,", text),
        lambda text: text.partition(b"\n")[2],
        lambda text: text.replace(b"seconds: 1.25", b"seconds: -1"),
        lambda text: text.replace(b"seconds: 1.25", b"seconds: inf"),
        lambda text: re.sub(rb",[^,]*\n2,", rb",x\n2,", text),
    ],
)
def test_damage_is_told(spoil: Callable[[bytes], bytes]) -> None:
    spoilt = gzip.compress(spoil(gzip.decompress(encode(table()))))
    for content in (spoilt, encode(table())[:-20], b"not gzip"):
        with refused(ResultsError, "damaged", "00.csv.gz"):
            decode(content, PATH)


execution = partial(ExecutionSettings, Path("results"))


@pytest.mark.parametrize(
    ("settings", "given", "code", "quoted"),
    [
        (CampaignSettings, {"evaluations": 0}, "range", "evaluations is 0"),
        (CampaignSettings, {"evaluations": 10.0}, "range", "evaluations is 10.0"),
        (CampaignSettings, {"replicas": True}, "range", "replicas is True"),
        (CampaignSettings, {"seed": -1}, "range", "seed is -1"),
        (CampaignSettings, {"algorithms": {}}, "no-algorithm", "algorithms"),
        (CampaignSettings, {"algorithms": {"nsga3": {}}}, "unknown-algorithm", "'nsga3'"),
        (CampaignSettings, {"objectives": ("speed",)}, "unknown-objective", "'speed'"),
        (CampaignSettings, {"constraint_handling": "hope"}, "unknown-choice", "constraints"),
        (CampaignSettings, {"first_generation": "lucky"}, "unknown-choice", "random"),
        (chosen, {"names": ()}, "repeated", "()"),
        (chosen, {"names": ("nsga2", "nsga2")}, "repeated", "'nsga2', 'nsga2'"),
        (chosen, {"names": ("nsga2",), "populations": [("random", 10)]}, "repeated", "(nsga2)"),
        (chosen, {"names": ("mopso",), "populations": 2 * [("mopso", 10)]}, "repeated", "mopso"),
        (
            chosen,
            {"names": ("nsga3",), "populations": [("nsga3", 9)]},
            "unknown-algorithm",
            "nsga2",
        ),
        (execution, {"jobs": -1}, "range", "jobs is -1"),
        (execution, {"executor": "slurm"}, "unknown-choice", "processes, dask"),
        (execution, {"executor": "dask"}, "scheduler", "--scheduler"),
        (execution, {"scheduler": "tcp://host:8786"}, "scheduler", "--executor dask"),
        (execution, {"resume": True, "overwrite": True}, "resume-or-overwrite", "--overwrite"),
    ],
)
def test_wrong_settings_are_told(
    settings: Callable[..., Any], given: dict[str, Any], code: str, quoted: str
) -> None:
    with refused(SettingsError, code, quoted):
        settings(**given)


@pytest.mark.parametrize(
    ("objectives", "drivable"),
    [
        (("peak_force_1", "peak_force_2"), ("duration", "peak_force")),
        (("mean_force",), ("duration", "peak_force")),
        (("robust_force_1", "robust_force_2"), ("duration", "robust_force")),
    ],
)
def test_the_drivable_experiment_is_about_the_same_forces(
    objectives: tuple[str, ...], drivable: tuple[str, ...]
) -> None:
    settings = CampaignSettings(objectives=objectives, seed=5)
    assert drivable_settings(settings) == replace(settings, objectives=drivable, replicas=3)
    assert drivable_settings(replace(settings, replicas=2)).replicas == 2
    assert drivable_settings(settings, 7).replicas == 7
    with refused(SettingsError, "range", "replicas is 0"):
        drivable_settings(settings, 0)


def test_random_search_stays_random() -> None:
    assert CampaignSettings().starts_from_initial("nsga2")
    assert not CampaignSettings().starts_from_initial("random")
    assert not CampaignSettings(first_generation="random").starts_from_initial("nsga2")


def test_settings_spell_out_the_algorithms() -> None:
    settings = CampaignSettings(chosen(("mopso", "random"), (("mopso", 30), ("random", 7))))
    assert settings.algorithms["mopso"]["swarm"] == 30
    assert settings.algorithms["mopso"]["inertia"] == 0.4
    assert settings.algorithms["random"] == {"batch": 7}
    assert from_json(CampaignSettings, to_json(settings), "", "") == settings


def test_streams_differ_and_repeat() -> None:
    settings = CampaignSettings()
    streams = {
        (seed, name, replica): tuple(
            replace(settings, seed=seed).replica_rng(name, replica).integers(2**63, size=2)
        )
        for seed in (0, 1)
        for name in ("nsga2", "mopso", "random")
        for replica in range(20)
    }
    assert len(set(streams.values())) == len(streams)
    other = CampaignSettings(algorithms={"mopso": {}}, replicas=3, evaluations=5)
    assert tuple(other.replica_rng("mopso", 2).integers(2**63, size=2)) == streams[1, "mopso", 2]
