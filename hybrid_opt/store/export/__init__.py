"""Export of timed carries: CSV, JSON, ROS 2 and RAPID. docs/export.md describes the files."""

from hybrid_opt.store.export.formats import DEFAULT_STEP, FORMATS, export
from hybrid_opt.store.export.samples import sample_timing

__all__ = ["DEFAULT_STEP", "FORMATS", "export", "sample_timing"]
