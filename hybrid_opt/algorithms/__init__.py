"""NSGA-II, MOPSO and others by name, on pymoo's Algorithm interface."""

from hybrid_opt.algorithms.registry import make, names, settings_of
from hybrid_opt.algorithms.search import Evaluated, SearchResult, search

__all__ = ["Evaluated", "SearchResult", "make", "names", "search", "settings_of"]
