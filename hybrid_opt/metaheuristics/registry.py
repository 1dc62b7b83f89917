"""The search algorithms by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from pymoo.core.algorithm import Algorithm

from hybrid_opt.metaheuristics.mopso import Mopso
from hybrid_opt.metaheuristics.pymoo_algorithms import RandomSearch, nsga2, sms_emoa
from hybrid_opt.metaheuristics.settings import GeneticSettings, MopsoSettings, RandomSettings
from symbolic.array import Array
from symbolic.errors import SettingsError

Settings = GeneticSettings | MopsoSettings | RandomSettings


@dataclasses.dataclass(frozen=True)
class _Entry:
    title: str
    build: Callable[[Any, Array | None], Algorithm]
    defaults: Settings


REGISTRY: dict[str, _Entry] = {
    "nsga2": _Entry("NSGA-II", nsga2, GeneticSettings()),
    "mopso": _Entry("MOPSO", Mopso, MopsoSettings()),
    "mopso-turbulent": _Entry(
        "MOPSO, turbulent", Mopso, MopsoSettings(inertia=0.45, mutation_share=0.75)
    ),
    "sms-emoa": _Entry("SMS-EMOA", sms_emoa, GeneticSettings()),
    "random": _Entry("random search", RandomSearch, RandomSettings()),
}


def names() -> tuple[str, ...]:
    """The names that `make` knows."""
    return tuple(REGISTRY)


def title(name: str) -> str:
    """How an algorithm is called in print; another name stays as it is."""
    return REGISTRY[name].title if name in REGISTRY else name


def settings_of(name: str, overrides: Mapping[str, object] | None = None) -> Settings:
    """The effective settings of an algorithm: its defaults with `overrides`.

    Raises:
        SettingsError: unknown algorithm or setting, or a value outside its range.
    """
    if name not in REGISTRY:
        raise SettingsError(f"unknown algorithm '{name}'; known are {', '.join(REGISTRY)}")
    defaults = REGISTRY[name].defaults
    known = [field.name for field in dataclasses.fields(defaults)]
    unknown = [key for key in overrides or {} if key not in known]
    if unknown:
        raise SettingsError(
            f"{name}: unknown setting {', '.join(unknown)}; known are {', '.join(known)}"
        )
    try:
        return dataclasses.replace(defaults, **dict(overrides or {}))  # type: ignore[arg-type]
    except TypeError as error:
        raise SettingsError(f"{name}: a setting has a value of the wrong type ({error})") from error


def make(
    name: str,
    settings: Settings | Mapping[str, object] | None = None,
    initial: Array | None = None,
) -> Algorithm:
    """A fresh algorithm for one run.

    Args:
        name: one of `names()`.
        settings: from `settings_of`, or values that differ from the defaults, see
            `hybrid_opt.metaheuristics.settings`.
        initial: (k, n_var) decision vectors that the first generation starts with, the rest
            being uniformly random; None for all random.

    Raises:
        SettingsError: as `settings_of`; wrong `initial` points are told when the run starts.
    """
    if dataclasses.is_dataclass(settings):
        settings = dataclasses.asdict(settings)
    effective = settings_of(name, settings)
    return REGISTRY[name].build(effective, initial)
