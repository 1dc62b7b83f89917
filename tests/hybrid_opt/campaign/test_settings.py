"""Settings are checked where they are made, and replicas draw from streams of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.campaign.settings import chosen
from hybrid_opt.campaign.stages import drivable_settings
from hybrid_opt.store.json_records import from_json, to_json
from symbolic.errors import SettingsError


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"evaluations": 0}, "evaluations is 0; allowed are whole numbers 1 to"),
        ({"evaluations": 10.0}, r"evaluations is 10\.0"),
        ({"replicas": True}, "replicas is True"),
        ({"seed": -1}, "seed is -1; allowed are whole numbers 0 to"),
        ({"algorithms": {}}, "name at least one"),
        ({"algorithms": {"nsga3": {}}}, "unknown algorithm 'nsga3'; known are"),
        ({"algorithms": {"nsga2": {"swarm": 10}}}, "nsga2: unknown setting swarm"),
        ({"algorithms": {"nsga2": {"population": 1}}}, "population is 1; allowed are whole"),
        ({"objectives": ("speed",)}, "unknown objective speed; known are"),
        ({"constraint_handling": "hope"}, "'hope'; known are penalty, constraints"),
        ({"first_generation": "lucky"}, "'lucky'; known are initial, random"),
    ],
)
def test_wrong_settings_are_told(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        CampaignSettings(**change)


@pytest.mark.parametrize(
    ("names", "populations", "message"),
    [
        ((), (), "name at least one, each once"),
        (("nsga2", "nsga2"), (), "name at least one, each once"),
        (("nsga2", "mopso"), (("random", 10),), r"of the campaign \(nsga2, mopso\)"),
        (("nsga2",), (("nsga2", 10), ("nsga2", 20)), "at most once"),
        (("nsga3",), (("nsga3", 10),), "unknown algorithm 'nsga3'; known are"),
    ],
)
def test_wrong_algorithms_are_told(
    names: tuple[str, ...], populations: tuple[tuple[str, int], ...], message: str
) -> None:
    with pytest.raises(SettingsError, match=message):
        chosen(names, populations)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jobs": -1}, "jobs is -1"),
        ({"executor": "slurm"}, "'slurm'; known are processes, dask"),
        ({"executor": "dask"}, "needs a scheduler's address"),
        ({"scheduler": "tcp://host:8786"}, "needs a scheduler's address"),
    ],
)
def test_wrong_execution_is_told(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        ExecutionSettings(Path("results"), **change)


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
    with pytest.raises(SettingsError, match="replicas is 0"):
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
