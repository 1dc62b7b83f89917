"""Export of timed trajectories: CSV, JSON, ROS 2 and RAPID. docs/export.md describes the files."""

from hybrid_opt.store.export.formats import FORMATS, export_trajectory
from hybrid_opt.store.export.samples import SampledTrajectory, sample_trajectory

__all__ = ["FORMATS", "SampledTrajectory", "export_trajectory", "sample_trajectory"]
