"""NSGA-II, MOPSO and others by name, on pymoo's Algorithm interface."""

from hybrid_opt.metaheuristics.registry import make, names, settings_of
from hybrid_opt.metaheuristics.run import Evaluated, SearchResult, search

__all__ = ["Evaluated", "SearchResult", "make", "names", "search", "settings_of"]
