"""Whole jobs as bundles that robot drivers run. docs/reference/bundles.md describes them."""

from hybrid_opt.extras.bundles.bundle import TARGETS, Origin, export
from hybrid_opt.extras.bundles.job_file import BundleOptions

__all__ = ["TARGETS", "BundleOptions", "Origin", "export"]
