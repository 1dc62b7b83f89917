"""NSGA-II, MOPSO and others by name, on pymoo's Algorithm interface."""

from hybrid_opt.metaheuristics.run import Evaluated, SearchResult, make, names, search, settings_of

__all__ = ["Evaluated", "SearchResult", "make", "names", "search", "settings_of"]
