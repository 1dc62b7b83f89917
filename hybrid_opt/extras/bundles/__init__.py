"""Bundles of whole jobs that robot drivers run. docs/reference/bundles.md describes them."""

from hybrid_opt.extras.bundles.bundle import Origin, export
from hybrid_opt.extras.bundles.job_file import BundleOptions
from hybrid_opt.extras.bundles.targets import TARGETS

__all__ = ["TARGETS", "BundleOptions", "Origin", "export"]
